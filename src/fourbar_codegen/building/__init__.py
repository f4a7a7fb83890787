"""Text -> library: the one door to compilers, and the one to the cache's folder."""
