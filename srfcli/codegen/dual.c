typedef double lanes __attribute__((vector_size(8 * LANES), may_alias));
typedef struct { double v; lanes d; } dual; /* a number and its derivatives in LANES directions */
static inline dual srf_scaled(double v, double s, dual a) { dual r = {v, s * a.d}; return r; }
static inline dual srf_plain(double v) { dual r = {v, (lanes){0.0}}; return r; }
static inline dual srf_add(dual a, dual b) { dual r = {a.v + b.v, a.d + b.d}; return r; }
static inline dual srf_sub(dual a, dual b) { dual r = {a.v - b.v, a.d - b.d}; return r; }
static inline dual srf_mul(dual a, dual b) { dual r = {a.v * b.v, a.v * b.d + b.v * a.d}; return r; }
static inline dual srf_div(dual a, dual b) { double i = 1.0 / b.v, q = a.v * i; dual r = {q, i * (a.d - q * b.d)}; return r; }
static inline dual srf_add_c(dual a, double b) { a.v += b; return a; }
static inline dual srf_mul_c(dual a, double b) { return srf_scaled(a.v * b, b, a); }
static inline dual srf_c_div(double a, dual b) { double q = a / b.v; return srf_scaled(q, -q / b.v, b); }
static inline dual srf_pow_c(dual a, double b) {
    if (b == 2.0) return srf_scaled(a.v * a.v, 2.0 * a.v, a);
    double q = pow(a.v, b - 1.0);
    return srf_scaled(q * a.v, b * q, a);
}
static inline dual srf_pow(dual a, dual b) {
    double q = pow(a.v, b.v);
    dual r = {q, q * (b.v / a.v * a.d + log(a.v) * b.d)};
    return r;
}
static inline dual srf_c_pow(double a, dual b) { double q = pow(a, b.v); return srf_scaled(q, q * log(a), b); }
