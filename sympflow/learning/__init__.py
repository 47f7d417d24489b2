"""Learning from trajectories: the data, the fit of a Hamiltonian and its flow, and the formula behind them."""
