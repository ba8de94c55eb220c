"""Linear Gaussian algebra: noise Σ, nuisances A c, and evidence with both integrated out. It knows neither cells nor recordings."""
