"""What a measurement of each kind says of beam and effects: from files to rows."""
