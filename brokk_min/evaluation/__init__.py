"""The paper's experiment: controllers, sequences, figures of merit, claims, report."""
