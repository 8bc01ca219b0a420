"""Guard Python's ``ast``, which one thread at a time may use."""

import threading

PARSING = threading.Lock()
"""Held by whoever parses Python's syntax, as NumPy does with the header of an array.

CPython 3.11 counts the depth of that recursion for all threads together, and now and then refuses what is right in one of several
(SystemError, https://github.com/python/cpython/issues/106905).
"""
