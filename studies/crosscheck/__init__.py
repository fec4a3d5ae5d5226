"""Cross-validation of closed-form shading with path tracing (`python -m studies.crosscheck`)."""
