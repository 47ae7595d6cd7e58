"""Networks of others, occupancy networks, and fields with colours."""
