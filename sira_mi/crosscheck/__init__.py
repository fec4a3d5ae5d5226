"""One page about one avatar: its closed-form picture against the path-traced one (`python -m sira_mi.crosscheck`)."""
