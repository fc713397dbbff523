"""One area's part of the estimate of the whole grid: boundary loads, iteration, bad data, gateways' mistakes, ADMM."""
