"""Published numbers that more than one page shows."""

# DVR (Niemeyer et al. 2020), Table 2: accuracy, completeness and Chamfer-L1, means over three scans of DTU, in mm.
DVR_SCANS = (65, 106, 118)
DVR_TABLE2 = {
    "Colmap + sPSR, trim 0": (1.881, 0.726, 1.303),
    "Colmap + sPSR, trim 5": (1.400, 0.782, 1.091),
    "Colmap + sPSR, trim 7": (0.446, 1.020, 0.733),
    "DVR (RGB)": (1.054, 0.760, 0.907),
    "DVR (RGB and depth)": (0.789, 0.775, 0.782),
}
