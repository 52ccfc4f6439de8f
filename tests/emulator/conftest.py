"""Settings of these tests."""
