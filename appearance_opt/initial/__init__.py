"""First guesses: decimated mesh or sphere, UV atlas, closed-form transfer."""
