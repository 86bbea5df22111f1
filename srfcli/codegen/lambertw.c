static double srf_lambertw(double x) { /* principal branch, x > -1/e */
    double w = x < 1.0 ? x / (1.0 + x) : log(x) - log(1.0 + log(x));
    for (int i = 0; i < 50; i++) {
        double e = exp(w), f = w * e - x, step = f / (e * (w + 1.0) - (w + 2.0) * f / (2.0 * w + 2.0));
        w -= step;
        if (fabs(step) <= 1e-15 * (1.0 + fabs(w))) break;
    }
    return w;
}
