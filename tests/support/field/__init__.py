"""A feeder with meters, a broker, an OPC UA server and a Modbus device around it, as processes."""
