"""From YAML text to checked objects: units, places, diagnostics."""
