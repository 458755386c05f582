"""Reports: what was learned of an object, in words and figures."""
