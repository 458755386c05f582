"""The GraspDB service: FastAPI routes over use cases over storage."""

__version__ = "0.1.0"
