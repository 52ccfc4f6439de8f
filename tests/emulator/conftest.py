"""Settings of these tests."""

from hypothesis import settings

settings.register_profile("no_stopwatch", deadline=None)  # a busy computer is not a failure
settings.load_profile("no_stopwatch")
