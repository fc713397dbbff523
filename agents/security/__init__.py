"""Who may publish: keys, certificates and access rules."""
