"""Commands for developers: benchmarks, generators, long runs."""
