"""Scenes: objects at rest on a table, packed upright, or dropped into a bin."""
