/* Radau IIA of order 5 for one slider: one step.

   Compiled behind lu.c, for all models of NX states; linked with a model, whose text has what is declared here.
   Method and error estimate: Hairer & Wanner, Solving Ordinary Differential Equations II, IV.8. The stage equations are solved by
   Newton's method with the Jacobian of each stage. Their matrix is sparse: states that few rates depend on are eliminated first,
   and a pivot is left on the diagonal unless it is small (Duff, Erisman and Reid, Direct Methods for Sparse Matrices, 1986). */

#define NZ (3 * NX)

MODEL void srf_rates(const double *x, double V, double W, double W_dot, const double *p, double *out);    /* (NX) */
MODEL void srf_jacobian(const double *x, double V, double W, double W_dot, const double *p, double *out); /* (NX, NX) */
MODEL extern const int NP;                  /* parameters */
MODEL extern const int NJ, JACOBIAN[];      /* where the Jacobian's entries may differ from zero */
MODEL extern const int PLACE[];             /* of each state in the order of elimination */
MODEL extern const int ROWS[];              /* of each unknown among the stages' states */

#define MAX_NEWTON 12
#define ALIKE 0.02                          /* of a step's length, within which the matrix of another is tried for it */
#define SLOW 0.1                            /* contraction of Newton's method from which such a matrix is renewed */
#define MAX_UNSEEN 100000                   /* steps shorter than the resolution of t */

static const double C[3] = {0.15505102572168219018, 0.64494897427831780982, 1.0};
static const double A[3][3] = {
    {0.19681547722366042869, -0.06553542585019838810, 0.02377097434822015242},
    {0.39442431473908727700, 0.29207341166522846302, -0.04154875212599793019},
    {0.37640306270046727505, 0.51248582618842161384, 0.11111111111111111111}};
/* error estimate: weights of the stage increments, and the real eigenvalue of A^-1 */
static const double E[3] = {-10.04880939982741556, 1.38214273316074890, -0.33333333333333333};
static const double U1 = 3.63783425274449573;

typedef struct {
    int n_knots, degree;
    const double *knots, *coefficients;
    int low, high, at;                      /* pieces that hold in this segment, and the last one used */
    double V, acceleration, since;
    const double *p;
} Imposed;

static void imposed(Imposed *f, double t, double *V, double *W, double *W_dot) {
    int i = f->at;
    while (i > f->low && t < f->knots[i]) i--;
    while (i < f->high && t >= f->knots[i + 1]) i++;
    f->at = i;
    const double *c = f->coefficients + (size_t)i * (f->degree + 1), h = t - f->knots[i];
    double value = c[f->degree], slope = 0.0;
    for (int k = f->degree - 1; k >= 0; k--) {
        slope = slope * h + value;
        value = value * h + c[k];
    }
    *W = value;
    *W_dot = slope;
    *V = f->V + f->acceleration * (t - f->since);
}

/* the rates, and their Jacobian, at a time and a state */
static void rates_at(Imposed *force, double t, const double *x, double *f) {
    double V, W, W_dot;
    imposed(force, t, &V, &W, &W_dot);
    memset(f, 0, NX * sizeof(double));
    srf_rates(x, V, W, W_dot, force->p, f);
}

static void jacobian_at(Imposed *force, double t, const double *x, double *J) {
    double V, W, W_dot;
    imposed(force, t, &V, &W, &W_dot);
    memset(J, 0, NX * NX * sizeof(double));
    srf_jacobian(x, V, W, W_dot, force->p, J);
}

#define AT(i, r) (3 * PLACE[r] + (i))       /* place of state r of stage i in the stages' matrix */

/* LU of I - h A (x) J with the Jacobian of each stage; h is 0 where there is none */
typedef struct {
    double a[NZ * NZ], h;
    int pivot[NZ];
} StageMatrix;

static int stage_matrix(StageMatrix *m, const double J[3][NX * NX], double h) {
    memset(m->a, 0, sizeof m->a);
    for (int k = 0; k < NZ; k++) m->a[k * NZ + k] = 1.0;
    for (int n = 0; n < NJ; n++) {
        int r = JACOBIAN[n] / NX, c = JACOBIAN[n] % NX;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) m->a[AT(i, r) * NZ + AT(j, c)] -= h * A[i][j] * J[j][JACOBIAN[n]];
    }
    m->h = factor(NZ, THRESHOLD, m->a, m->pivot) ? h : 0.0;
    return m->h > 0.0;
}

/* B (3 x NX x m) is solved in place */
static NOINLINE void solve_stages(const StageMatrix *matrix, double *B, int m) {
    solve(NZ, matrix->a, matrix->pivot, ROWS, B, m);
}

static double norm(const double *d, const double *x, double rtol, const double *atol) {
    double sum = 0.0;
    for (int i = 0; i < NX; i++) {
        double e = d[i] / (atol[i] + rtol * fabs(x[i]));
        sum += e * e;
    }
    return sqrt(sum / NX);
}

static int finite_all(const double *x, int n) {
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}

typedef struct {
    double t, x[NX], f[NX];                 /* f is the slope for output: from the increments, see segment() of integrate.c */
} Node;

/* shortens a step to what is left, or to half of it, so that no sliver remains; returns whether it is the last */
static int fitted(double *h, double left) {
    int final = *h >= left * (1.0 - 1e-12);
    if (final) *h = left;
    else if (2.0 * *h > left) *h = 0.5 * left;
    return final;
}

/* the time after a step towards b, and in `carry` what it has lost of h by rounding */
static double time_after(double t, double h, double b, int final, double *carry) {
    double ahead = h + *carry, after = final ? b : t + ahead;
    *carry = final ? 0.0 : ahead - (after - t);
    return after;
}

/* the stages' matrix at the increments Z, with loads and drive of the stages; returns 0 where it is none */
static int linearised(StageMatrix *matrix, const Node *from, double h, const double *Z, const double *V, const double *W, const double *W_dot, const double *p) {
    double J[3][NX * NX], x[NX];
    for (int i = 0; i < 3; i++) {
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
        memset(J[i], 0, sizeof J[i]);
        srf_jacobian(x, V[i], W[i], W_dot[i], p, J[i]);
        if (!finite_all(J[i], NX * NX)) return 0;
    }
    return stage_matrix(matrix, (const double(*)[NX * NX])J, h);
}

/* One attempt at a step: fills Z; returns the Newton count, 0 where it failed. `matrix` is taken as it is where it belongs to about
   this h, and renewed where Newton's method is slow with it. */
static NOINLINE int stages(Imposed *force, const Node *from, double h, const double *Z0, double rtol, const double *atol, double *Z, StageMatrix *matrix) {
    double residual[NZ], F[3][NX], x[NX], V[3], W[3], W_dot[3], last = 0.0;
    int fresh = !(fabs(matrix->h - h) <= ALIKE * h);
    memcpy(Z, Z0, NZ * sizeof(double));
    for (int i = 0; i < 3; i++) imposed(force, from->t + C[i] * h, &V[i], &W[i], &W_dot[i]);
    if (fresh && !linearised(matrix, from, h, Z, V, W, W_dot, force->p)) return 0;
    for (int newton = 1; newton <= MAX_NEWTON; newton++) {
        for (int i = 0; i < 3; i++) {
            for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
            memset(F[i], 0, sizeof F[i]);
            srf_rates(x, V[i], W[i], W_dot[i], force->p, F[i]);
        }
        for (int i = 0; i < 3; i++)
            for (int r = 0; r < NX; r++)
                residual[i * NX + r] = h * (A[i][0] * F[0][r] + A[i][1] * F[1][r] + A[i][2] * F[2][r]) - Z[i * NX + r];
        int finite = finite_all(residual, NZ);
        double size = 0.0, rate = INFINITY;
        if (finite) {
            solve(NZ, matrix->a, matrix->pivot, ROWS, residual, 1);
            for (int i = 0; i < 3; i++) {
                double e = norm(residual + i * NX, from->x, rtol, atol);
                size = e > size ? e : size;
            }
            rate = newton > 1 ? size / last : 0.0;
        }
        if (!fresh && rate > SLOW) { /* from the start: what was gone may lead astray */
            memcpy(Z, Z0, NZ * sizeof(double));
            if (!linearised(matrix, from, h, Z, V, W, W_dot, force->p)) return 0;
            fresh = 1;
            newton = 0;
            continue;
        }
        if (!finite) return 0;
        for (int k = 0; k < NZ; k++) Z[k] += residual[k];
        double enough = fresh ? 1e-3 : 1e-4;  /* of the tolerance: the first correction by an older matrix leaves more */
        if (newton > 1 && rate >= 1.0 && size > enough) return 0;
        if (size <= enough || (newton > 1 && rate < 1.0 && size * rate / (1.0 - rate) <= enough)) return newton;
        last = size;
    }
    return 0;
}

/* U1 / h - J0 factored, by which error estimates are filtered; returns 0 where it is singular */
static NOINLINE int estimate_matrix(const double *J0, double h, double *matrix, int *pivot) {
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++) matrix[r * NX + c] = (r == c ? U1 / h : 0.0) - J0[r * NX + c];
    return factor(NX, 1.0, matrix, pivot);
}

/* columns of e (NX x m) are filtered in place */
static NOINLINE void filter_estimate(const double *matrix, const int *pivot, double *e, int m) {
    solve(NX, matrix, pivot, NULL, e, m);
}

/* the embedded estimate of order 3, filtered by the Jacobian at the step's start */
static double estimate(Imposed *force, const Node *from, const double *f0, double h, const double *Z, const double *J0, double rtol, const double *atol, int cautious) {
    double matrix[NX * NX], known[NX], e[NX], x[NX], f[NX];
    int pivot[NX];
    for (int r = 0; r < NX; r++) {
        known[r] = (E[0] * Z[r] + E[1] * Z[NX + r] + E[2] * Z[2 * NX + r]) / h;
        e[r] = known[r] + f0[r];
    }
    if (!estimate_matrix(J0, h, matrix, pivot)) return INFINITY;
    filter_estimate(matrix, pivot, e, 1);
    double size = norm(e, from->x, rtol, atol);
    if (size >= 1.0 && cautious) {
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + e[r];
        rates_at(force, from->t, x, f);
        for (int r = 0; r < NX; r++) e[r] = known[r] + f[r];
        if (finite_all(e, NX)) {
            filter_estimate(matrix, pivot, e, 1);
            size = norm(e, from->x, rtol, atol);
        }
    }
    return isfinite(size) ? fmax(size, 1e-10) : INFINITY;
}

/* extrapolates the last step's collocation polynomial to the stages of the next one; increments from its start */
static void predict(const double *Z, double before, double h, double *Z0) {
    const double node[4] = {0.0, C[0], C[1], 1.0};
    for (int i = 0; i < 3; i++) {
        double s = 1.0 + C[i] * h / before;
        for (int r = 0; r < NX; r++) Z0[i * NX + r] = -Z[2 * NX + r];
        for (int k = 1; k < 4; k++) {
            double l = 1.0;
            for (int j = 0; j < 4; j++)
                if (j != k) l *= (s - node[j]) / (node[k] - node[j]);
            for (int r = 0; r < NX; r++) Z0[i * NX + r] += l * Z[(k - 1) * NX + r];
        }
    }
}

typedef struct {
    double Z[NZ], before;                   /* increments and length of the last step, from which the next is predicted; 0 for none */
    double last_h, last_error;              /* of the last step that was taken, 0 for none */
    int rejected;                           /* whether the step at hand was, before */
} Control;

/* One attempt at a step as stages() makes it: from the last one's polynomial, then from rest; with its own matrix where that is
   to be taken `anew` */
static int attempt(Imposed *force, const Node *from, double h, const Control *control, int anew, double rtol, const double *atol, double *Z, StageMatrix *matrix) {
    double Z0[NZ];
    int newton = 0;
    for (int known = control->before > 0.0; !newton && known >= 0; known--) {
        if (known) predict(control->Z, control->before, h, Z0);
        else memset(Z0, 0, sizeof Z0);
        if (anew) matrix->h = 0.0;
        newton = stages(force, from, h, Z0, rtol, atol, Z, matrix);
    }
    return newton;
}

/* the length of the next step after one of h with this error, over what is allowed: it is taken below 1 and else tried again;
   predictive controller of Gustafsson */
static double next_length(Control *control, double h, double error, int newton) {
    double safety = 0.9 * (2 * MAX_NEWTON + 1.0) / (2 * MAX_NEWTON + (newton ? newton : MAX_NEWTON));
    double growth = isfinite(error) ? fmin(8.0, fmax(0.2, safety * pow(error, -0.25))) : 0.25;
    if (!(error < 1.0)) {
        growth = fmin(growth, control->rejected || isinf(error) ? 0.5 : 0.9);
        control->rejected = 1;
        return h * growth;
    }
    if (control->last_h > 0.0) {
        double predicted = safety * (h / control->last_h) * pow(error * error / control->last_error, -0.25);
        growth = fmin(growth, fmax(0.2, fmin(8.0, predicted)));
    }
    if (control->rejected) growth = fmin(growth, 1.0);
    control->last_h = h;
    control->last_error = fmax(error, 1e-2);
    control->rejected = 0;
    return h * growth;
}

static double first_step(Imposed *force, const Node *n, double span, double rtol, const double *atol) {
    double x[NX], f[NX], d[NX];
    double d0 = norm(n->x, n->x, rtol, atol), d1 = norm(n->f, n->x, rtol, atol);
    double h = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    h = fmin(h, span);
    for (int r = 0; r < NX; r++) x[r] = n->x[r] + h * n->f[r];
    rates_at(force, n->t + h, x, f);
    for (int r = 0; r < NX; r++) d[r] = (f[r] - n->f[r]) / h;
    double d2 = norm(d, n->x, rtol, atol), steepest = fmax(d1, d2);
    if (!isfinite(steepest)) return fmin(1e-9, span);
    double second = steepest <= 1e-15 ? fmax(1e-6, h * 1e-3) : pow(0.01 / steepest, 0.25);
    return fmin(fmin(100.0 * h, second), span);
}
