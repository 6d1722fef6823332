"""Figures as SVG text, a module a subject: values in, a picture out."""
