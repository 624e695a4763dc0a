"""Attempts to break the renderer, as tests (`make stress`), and what other tests use of them."""
