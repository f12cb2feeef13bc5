"""From a recording to a result: settled period or any motion, physical quantities, comparison."""
