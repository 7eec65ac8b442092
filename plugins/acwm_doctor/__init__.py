"""Test what works on this machine."""
