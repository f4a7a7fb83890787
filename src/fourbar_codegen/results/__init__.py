"""Results of simulations: data, with methods that plot and save them."""
