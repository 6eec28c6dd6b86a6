"""The avatar as torch modules, its template and its checkpoint."""
