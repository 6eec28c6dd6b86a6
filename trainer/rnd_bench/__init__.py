"""The laboratory: benchmarks, the stability suite and studies."""
