"""Who may ask and how often: keys, their ring in memory, rates; and the audit read back."""
