"""The benchmark of portraits: rendered photos with known truth, methods that fit them, scores, figures and page."""
