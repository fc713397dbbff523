"""Real meters and operators: gateways to field protocols, and commands to a running system."""
