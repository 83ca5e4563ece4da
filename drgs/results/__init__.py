"""What commands share: a fit's folder, history, metrics, models to render, ``viewer.html``."""
