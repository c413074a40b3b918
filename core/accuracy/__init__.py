"""Error against cost for the user's own pipeline: `zonda accuracy`."""
