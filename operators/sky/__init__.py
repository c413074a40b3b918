"""The sky: input maps, beams and sampling."""
