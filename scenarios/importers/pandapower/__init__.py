"""Networks and measurements of pandapower, as `to_json` writes them."""
