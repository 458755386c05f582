"""``python -m graspdb``."""

from graspdb.cli import main

main()
