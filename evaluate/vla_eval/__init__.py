"""vla-eval, both ways: its policy servers, and RoboMME-Interference as one of its benchmarks."""
