"""From a recording to a result: settled or arbitrary motion, physical quantities, comparisons."""
