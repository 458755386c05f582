"""The page's panels: each a part of what is shown, with its controls."""
