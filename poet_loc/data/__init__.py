"""Data: BOP sets, batches and the synthetic world."""
