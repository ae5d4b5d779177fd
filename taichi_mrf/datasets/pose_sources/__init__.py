"""Where the poses of a recording's frames come from, if not from the recording, and how they change."""
