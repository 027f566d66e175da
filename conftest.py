"""Loads the option `--script` before pytest reads the command line; the fixtures are in tests/conftest.py."""

pytest_plugins = ["siblings"]
