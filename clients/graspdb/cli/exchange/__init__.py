"""Commands that exchange files with other programs and other databases."""
