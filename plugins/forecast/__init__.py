"""The noise of a map, forecast without a run: `zonda sensitivity`."""
