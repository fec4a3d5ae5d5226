"""The evidence beside the product: how good fits and priors are, and where they stop. Runs from a checkout."""
