"""Run policies on the benchmark, and score what came out."""
