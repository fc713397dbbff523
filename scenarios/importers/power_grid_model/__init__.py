"""Networks and sensors of power-grid-model, as `json_serialize_to_file` writes them."""
