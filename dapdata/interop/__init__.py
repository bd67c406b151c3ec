"""Other tools' formats, in and out: one or more files for each, and what all exports have in common in `export`."""
