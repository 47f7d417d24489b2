"""Arrays on disk: stores that grow while a run goes on, in zarr's format, and conversions to xarray."""
