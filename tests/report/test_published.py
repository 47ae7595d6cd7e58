"""The published numbers, typed a second time from the papers' tables, in their order."""

from bench.report.study import published

# DIST, Table 1: steps, queries, time.
TABLE1 = """
naive_serial               50   N/A    N/A
naive_practical            50   6.06M  1.6h
naive_practical_parallel   50   6.06M  3.39s
dist_dynamic               50   1.99M  1.23s
dist_aggressive            50   1.43M  1.08s
dist_coarse_to_fine        50   887K   0.99s
dist_coarse_to_fine_100    100  898K   1.24s
"""
# DIST, Table 2: family, dense, 50%, 10%, 100, 50, 20 points; "Ours" is DIST.
TABLE2 = """
sofa   DeepSDF         5.37   5.56   5.50   5.93   6.03   7.63
sofa   DIST            4.12   5.75   5.49   5.72   5.57   6.95
sofa   DIST_with_mask  4.12   3.98   4.31   3.98   4.30   4.94
plane  DeepSDF         3.71   3.73   4.29   4.44   4.40   5.39
plane  DIST            2.18   4.08   4.81   4.44   4.51   5.30
plane  DIST_with_mask  2.18   2.08   2.62   2.26   2.55   3.60
table  DeepSDF         12.93  12.78  11.67  12.87  13.76  15.77
table  DIST            5.37   12.05  11.42  11.70  13.76  15.83
table  DIST_with_mask  5.37   5.15   5.16   5.26   6.33   7.62
"""
# DIST, Table 3: car, plane.
TABLE3 = """
PMO                 0.661  1.129
PMO,_random_start   1.187  6.124
DIST,_random_start  0.919  1.595
"""


def lines(text: str) -> list[list[str]]:
    return [[word.replace("_", " ") for word in line.split()] for line in text.strip().splitlines()]


def test_table_1():
    typed = {preset.replace(" ", "_"): ["512", *rest] for preset, *rest in lines(TABLE1)}
    assert [(row, list(cells.values())) for row, cells in published("dist_table1").items()] == list(typed.items())


def test_table_2():
    for family, row, *numbers in lines(TABLE2):
        assert numbers == list(published("dist_table2")[family][row].values())
    assert sum(map(len, published("dist_table2").values())) == len(lines(TABLE2))


def test_table_3():
    for row, car, plane in lines(TABLE3):
        assert (published("dist_table3")["car"][row], published("dist_table3")["plane"][row]) == (car, plane)
    assert {len(rows) for rows in published("dist_table3").values()} == {len(lines(TABLE3))}
