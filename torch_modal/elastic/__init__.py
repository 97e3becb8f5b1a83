"""The shell energy (Eq. 5) and its derivatives."""
