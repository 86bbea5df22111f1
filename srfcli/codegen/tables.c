/* a table is a cubic spline with evenly spaced knots: offset of its numbers in p, first knot, spacing, how many numbers */
static int srf_cell(const double *p, int i, double x, double *share) {
    const double *head = p + NP + 4 * i;
    double r = (x - head[1]) / head[2], last = head[3] - 3.0;
    if (!(r > 0.0)) r = 0.0;
    if (r > last) r = last;
    int j = (int)r;
    if (j > (int)last - 1) j = (int)last - 1;
    *share = r - j;
    return j;
}
static void srf_weights(double f, double *b, double *d, double *e) {
    double g = 1.0 - f;
    b[0] = g * g * g / 6.0; b[3] = f * f * f / 6.0;
    b[1] = (4.0 - 6.0 * f * f + 3.0 * f * f * f) / 6.0; b[2] = 1.0 - b[0] - b[1] - b[3];
    d[0] = -0.5 * g * g; d[3] = 0.5 * f * f; d[1] = -2.0 * f + 1.5 * f * f; d[2] = -d[0] - d[1] - d[3];
    e[0] = g; e[3] = f; e[1] = 3.0 * f - 2.0; e[2] = 1.0 - 3.0 * f;
}
static double srf_spline(const double *p, int i, double x, int order) {
    const double *head = p + NP + 4 * i;
    if (head[3] < 4.0) return 0.0;
    double f, w[3][4], sum = 0.0;
    int j = srf_cell(p, i, x, &f);
    if (order && (x < head[1] || x > head[1] + head[2] * (head[3] - 3.0))) return 0.0;
    srf_weights(f, w[0], w[1], w[2]);
    for (int k = 0; k < 4; k++) sum += w[order][k] * p[(int)head[0] + j + k];
    return order == 0 ? sum : order == 1 ? sum / head[2] : sum / (head[2] * head[2]);
}
static double srf_lut(const double *p, double i, double x) { return srf_spline(p, (int)i, x, 0); }
static double srf_lut1(const double *p, double i, double x) { return srf_spline(p, (int)i, x, 1); }
static double srf_lut2(const double *p, double i, double x) { return srf_spline(p, (int)i, x, 2); }
