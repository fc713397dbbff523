"""The sources that are shipped: CSV files that grow, JSON lines, MQTT, OPC UA, Modbus."""
