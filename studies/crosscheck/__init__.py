"""Cross-check of closed forms against path tracing (`python -m studies.crosscheck`)."""
