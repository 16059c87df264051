"""Programs that measure: each prints the table that the README shows."""
