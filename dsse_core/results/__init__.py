"""Tables of buses, branches, meters and areas that follow from a state, in p.u. and in kV, kW, kvar and A."""
