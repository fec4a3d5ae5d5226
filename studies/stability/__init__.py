"""How exact the project's formulas, samplers and ray tracing are in single precision, at the ends of their ranges too:
`python -m studies.stability` measures and writes `docs/stability.md`."""
