"""The experiment simulated before anything moves: what to expect, and the largest safe amplitude."""
