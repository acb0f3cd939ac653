"""Records the results of small seeded runs, and checks that a change leaves their bits."""
