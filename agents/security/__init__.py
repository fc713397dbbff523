"""Security of the bus: keys, certificates, and access rules of publishers and subscribers."""
