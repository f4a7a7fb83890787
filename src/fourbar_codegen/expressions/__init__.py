"""Expressions as straight-line code: kept once, differentiated, compared, written as data."""
