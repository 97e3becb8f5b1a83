"""Stored key-frame sets, random transforms and datasets of shapes."""
