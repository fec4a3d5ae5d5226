"""Evidence: how good the priors are, measured on heads that they have not seen."""
