"""How well priors describe heads that they have not seen, and what each loss term and network size is for."""
