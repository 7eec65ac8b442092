"""A benchmark that any program can enter: tasks for participants, scores of what they predict."""
