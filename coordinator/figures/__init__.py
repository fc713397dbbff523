"""Pictures: figures of a run and of studies, diagrams of networks; how they look and how they are written."""
