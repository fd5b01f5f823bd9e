"""Maps of what a fitted model predicts over an area."""
