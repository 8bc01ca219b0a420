"""A real browser, as the other pages have it."""

from tests.output.conftest import chromium  # noqa: F401 (a fixture)
