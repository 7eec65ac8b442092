"""`acwm serve`: a trained model behind a websocket, for robots and other programs."""
