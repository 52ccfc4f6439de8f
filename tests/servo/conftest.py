"""Its folder is in the path of the tests below it: they share the rigs here."""
