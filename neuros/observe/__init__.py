"""What a run leaves behind for people: tables and records."""
