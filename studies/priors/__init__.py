"""Evidence for the priors, measured on heads that they have not seen, and what each loss term and size is for."""
