"""Weather: sources of profiles, absorption, radiative transfer, passbands."""
