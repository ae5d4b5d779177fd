"""Sources of the poses of a recording's frames other than the recording, whose poses may change."""
