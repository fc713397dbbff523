"""What follows from a state: tables of buses, branches, meters and areas, in p.u. and in kV, kW, kvar and A."""
