"""Datasets in the formats of other tools: one file for each, and what all exports have in common in `export`."""
