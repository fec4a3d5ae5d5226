"""The benchmark of portraits: photos with known truth, methods that fit them, scores, the page of results."""
