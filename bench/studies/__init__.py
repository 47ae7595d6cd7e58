"""The questions: a file each, named as its experiment, found by listing. The harness imports none of them."""
