"""What simulations give: data, and the doors to files and figures."""
