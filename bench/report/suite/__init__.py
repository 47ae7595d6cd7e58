"""The suite: every renderer on the same problems within the same budgets. `attempts` has its rows, `standing` ranks."""
