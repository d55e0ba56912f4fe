"""Families of queries, frozen in TOML files."""
