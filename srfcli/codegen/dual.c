typedef double lanes __attribute__((vector_size(8 * LANES), may_alias));
typedef struct { double v; lanes d; } dual; /* a number and its derivatives in LANES directions */
static inline dual srf_scaled(double v, double s, dual a) { dual r = {v, s * a.d}; return r; }
static inline dual srf_plain(double v) { dual r = {v, (lanes){0.0}}; return r; }
static inline dual srf_add(dual a, dual b) { dual r = {a.v + b.v, a.d + b.d}; return r; }
static inline dual srf_sub(dual a, dual b) { dual r = {a.v - b.v, a.d - b.d}; return r; }
static inline dual srf_mul(dual a, dual b) { dual r = {a.v * b.v, a.v * b.d + b.v * a.d}; return r; }
static inline dual srf_div(dual a, dual b) { double i = 1.0 / b.v, q = a.v * i; dual r = {q, i * (a.d - q * b.d)}; return r; }
static inline dual srf_mul_c(dual a, double b) { return srf_scaled(a.v * b, b, a); }
/* derivatives of a step of a model from those of what it is computed from; called, as inlined they take most of the compiler's time */
static NOINLINE void srf_along_1(lanes *out, double p, const lanes *a) { *out = p * *a; }
static NOINLINE void srf_along_2(lanes *out, double p, const lanes *a, double q, const lanes *b) { *out = p * *a + q * *b; }
static NOINLINE void srf_along_3(lanes *out, double p, const lanes *a, double q, const lanes *b, double r, const lanes *c) {
    *out = p * *a + q * *b + r * *c;
}
