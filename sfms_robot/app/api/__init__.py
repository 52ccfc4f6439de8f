"""What `import sfms_robot` gives to programs: the parts of a run by themselves, and a run in a thread."""
