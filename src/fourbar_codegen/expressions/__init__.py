"""Expressions as straight-line code: hash-consed, differentiated, compared, written as data."""
