"""Linear Gaussian algebra: noise, nuisances, and evidence with both integrated out. It knows neither cells nor recordings."""
