"""Who may speak: keys, certificates and access rules."""
