"""The instrument at the other end of the cable, and the virtual one that stands in for it."""
