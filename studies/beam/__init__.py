"""A clamped silicone beam, recorded by motion capture, against the tissue model."""
