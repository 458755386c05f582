"""The formats that are read, a module each or for those that are alike: ``read(source, wishes, report)``."""
