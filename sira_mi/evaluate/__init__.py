"""How good the priors (`priors`) and the fits (`portraits`) are."""
