"""Subjects that not every lab needs; each is complete in its own folder."""
