"""A bake as one HTML page: WebGL2 draws it under any sky of few numbers, without a network."""
