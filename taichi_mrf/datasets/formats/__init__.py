"""Readers of recordings in folders and files, one small file a format."""
