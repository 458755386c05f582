"""The formats that are written, a module for those that are alike: ``write(path, content, report)``."""
