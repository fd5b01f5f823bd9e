"""Table of radio fields: entries of any program, scored on the same held-out rows, and the page that shows them."""
