"""Text -> library: the only modules that run compilers and write to the cache's folder."""
