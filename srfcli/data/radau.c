/* Radau IIA of order 5 for one slider, with the exact derivatives of its discrete solution by parameters and initial state.

   Compiled together with a model: NX states, NP parameters, NA appended constants, and
     srf_rates(x, V, W, W_dot, p, out[NX])        srf_jacobian(..., out[NX*NX])        srf_parameters(..., out[NX*NP])
   Method and error estimate: Hairer & Wanner, Solving Ordinary Differential Equations II, IV.8. Output between steps by the
   quintic Hermite polynomial through three nodes. The stage equations are solved by Newton's method with the Jacobian of each
   stage, so that one more factorisation with the converged Jacobians differentiates the step exactly. */

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NZ (3 * NX)
#define MAX_NEWTON 12
#define SHARE 30.0                          /* sensitivities are held to so much less than the states */
#define NODES 4                             /* kept for output between steps */
#define UNEVEN 50.0                         /* a neighbour so much shorter or longer would spoil the interpolation */

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

/* LU with partial pivoting in place, row-major; returns 0 where the matrix is singular */
static int factor(int n, double *a, int *pivot) {
    for (int k = 0; k < n; k++) {
        int best = k;
        double largest = fabs(a[k * n + k]);
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > largest) largest = fabs(a[i * n + k]), best = i;
        if (!(largest > 0.0) || !(largest <= DBL_MAX)) return 0;
        pivot[k] = best;
        if (best != k)
            for (int j = 0; j < n; j++) {
                double swap = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = swap;
            }
        double inverse = 1.0 / a[k * n + k];
        for (int i = k + 1; i < n; i++) {
            double m = a[i * n + k] * inverse;
            a[i * n + k] = m;
            if (m != 0.0)
                for (int j = k + 1; j < n; j++) a[i * n + j] -= m * a[k * n + j];
        }
    }
    return 1;
}

/* columns of b (n x m, row-major) are solved in place */
static void solve(int n, const double *a, const int *pivot, double *b, int m) {
    for (int k = 0; k < n; k++) {
        if (pivot[k] != k)
            for (int j = 0; j < m; j++) {
                double swap = b[k * m + j];
                b[k * m + j] = b[pivot[k] * m + j];
                b[pivot[k] * m + j] = swap;
            }
    }
    for (int k = 0; k < n; k++)
        for (int i = k + 1; i < n; i++) {
            double l = a[i * n + k];
            if (l != 0.0)
                for (int j = 0; j < m; j++) b[i * m + j] -= l * b[k * m + j];
        }
    for (int k = n - 1; k >= 0; k--) {
        double inverse = 1.0 / a[k * n + k];
        for (int j = 0; j < m; j++) b[k * m + j] *= inverse;
        for (int i = 0; i < k; i++) {
            double u = a[i * n + k];
            if (u != 0.0)
                for (int j = 0; j < m; j++) b[i * m + j] -= u * b[k * m + j];
        }
    }
}

/* I - h A (x) J with the Jacobian of each stage */
static int stage_matrix(const double J[3][NX * NX], double h, double *matrix, int *pivot) {
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < NX; r++)
            for (int j = 0; j < 3; j++)
                for (int c = 0; c < NX; c++)
                    matrix[(i * NX + r) * NZ + j * NX + c] = (i == j && r == c ? 1.0 : 0.0) - h * A[i][j] * J[j][r * NX + c];
    return factor(NZ, matrix, pivot);
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
    double t, x[NX], f[NX];
} Node;

/* weights of x and f at three nodes for the quintic Hermite polynomial at t; returns the number of nodes used */
static void hermite(int n, const double *node, double t, double *on_x, double *on_f) {
    for (int i = 0; i < n; i++) {
        double l = 1.0, slope = 0.0;
        for (int j = 0; j < n; j++)
            if (j != i) {
                l *= (t - node[j]) / (node[i] - node[j]);
                slope += 1.0 / (node[i] - node[j]);
            }
        on_x[i] = (1.0 - 2.0 * slope * (t - node[i])) * l * l;
        on_f[i] = (t - node[i]) * l * l;
    }
}

typedef struct {
    int ns;
    const int *which;
    const double *scale;                    /* of each column: a unit of change of what it is the derivative by */
    double *S, *Sf, *work;                  /* NX x ns at each node, one after another */
    int nodes;
    Node node[NODES];
} History;

static void sensitivity_rates(History *q, int slot, Imposed *force) {
    if (!q->ns) return;
    double V, W, W_dot, J[NX * NX], P[NX * NP];
    const Node *n = &q->node[slot];
    double *S = q->S + (size_t)slot * NX * q->ns, *F = q->Sf + (size_t)slot * NX * q->ns;
    imposed(force, n->t, &V, &W, &W_dot);
    memset(J, 0, sizeof J);
    memset(P, 0, sizeof P);
    srf_jacobian(n->x, V, W, W_dot, force->p, J);
    srf_parameters(n->x, V, W, W_dot, force->p, P);
    for (int r = 0; r < NX; r++)
        for (int k = 0; k < q->ns; k++) {
            double sum = q->which[k] < 0 ? 0.0 : P[r * NP + q->which[k]];
            for (int c = 0; c < NX; c++) sum += J[r * NX + c] * S[c * q->ns + k];
            F[r * q->ns + k] = sum;
        }
}

static void drop_oldest(History *q) {
    size_t size = (size_t)NX * q->ns;
    for (int i = 0; i + 1 < NODES; i++) q->node[i] = q->node[i + 1];
    if (size) {
        memmove(q->S, q->S + size, (NODES - 1) * size * sizeof(double));
        memmove(q->Sf, q->Sf + size, (NODES - 1) * size * sizeof(double));
    }
    q->nodes = NODES - 1;
}

/* the neighbour of nodes i and i + 1 whose distance is nearest to theirs, or -1 */
static int neighbour(const History *q, int i) {
    double h = q->node[i + 1].t - q->node[i].t, best = UNEVEN;
    int found = -1;
    for (int side = 0; side < 2; side++) {
        int k = side ? i + 2 : i - 1;
        if (k < 0 || k >= q->nodes) continue;
        double gap = side ? q->node[k].t - q->node[i + 1].t : q->node[i].t - q->node[k].t;
        double ratio = gap > h ? gap / h : h / gap;
        if (ratio < best) best = ratio, found = k;
    }
    return found;
}

/* writes every wanted time up to node i + 1, between it and node i */
static int write_outputs(History *q, int i, int next, int nt, const double *t, double *X, double *S) {
    if (next >= nt || t[next] > q->node[i + 1].t) return next;
    int use[3] = {i, i + 1, neighbour(q, i)}, n = use[2] < 0 ? 2 : 3, ns = q->ns;
    double time[3], on_x[3], on_f[3];
    for (int k = 0; k < n; k++) time[k] = q->node[use[k]].t;
    for (; next < nt && t[next] <= q->node[i + 1].t; next++) {
        hermite(n, time, t[next], on_x, on_f);
        for (int r = 0; r < NX; r++) {
            double sum = 0.0;
            for (int k = 0; k < n; k++) sum += on_x[k] * q->node[use[k]].x[r] + on_f[k] * q->node[use[k]].f[r];
            X[(size_t)next * NX + r] = sum;
        }
        for (int r = 0; r < NX * ns; r++) {
            double sum = 0.0;
            for (int k = 0; k < n; k++)
                sum += on_x[k] * q->S[(size_t)use[k] * NX * ns + r] + on_f[k] * q->Sf[(size_t)use[k] * NX * ns + r];
            S[(size_t)next * NX * ns + r] = sum;
        }
    }
    return next;
}

/* one attempt at a step: fills Z; returns the Newton count, 0 where it failed */
static int stages(Imposed *force, const Node *from, double h, const double *Z0, double rtol, const double *atol, double *Z, double J[3][NX * NX]) {
    double matrix[NZ * NZ], residual[NZ], F[3][NX], x[NX], V[3], W[3], W_dot[3];
    int pivot[NZ];
    double last = 0.0;
    memcpy(Z, Z0, NZ * sizeof(double));
    for (int i = 0; i < 3; i++) {
        imposed(force, from->t + C[i] * h, &V[i], &W[i], &W_dot[i]);
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
        memset(J[i], 0, sizeof J[i]);
        srf_jacobian(x, V[i], W[i], W_dot[i], force->p, J[i]);
        if (!finite_all(J[i], NX * NX)) return 0;
    }
    if (!stage_matrix((const double(*)[NX * NX])J, h, matrix, pivot)) return 0;
    for (int newton = 1; newton <= MAX_NEWTON; newton++) {
        for (int i = 0; i < 3; i++) {
            for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
            memset(F[i], 0, sizeof F[i]);
            srf_rates(x, V[i], W[i], W_dot[i], force->p, F[i]);
        }
        for (int i = 0; i < 3; i++)
            for (int r = 0; r < NX; r++)
                residual[i * NX + r] = h * (A[i][0] * F[0][r] + A[i][1] * F[1][r] + A[i][2] * F[2][r]) - Z[i * NX + r];
        if (!finite_all(residual, NZ)) return 0;
        solve(NZ, matrix, pivot, residual, 1);
        double size = 0.0;
        for (int i = 0; i < 3; i++) {
            double e = norm(residual + i * NX, from->x, rtol, atol);
            size = e > size ? e : size;
        }
        for (int k = 0; k < NZ; k++) Z[k] += residual[k];
        double rate = newton > 1 ? size / last : 0.0;
        if (newton > 1 && rate >= 1.0 && size > 1e-3) return 0;
        if (size <= 1e-3 || (newton > 1 && rate < 1.0 && size * rate / (1.0 - rate) <= 1e-3)) return newton;
        last = size;
    }
    return 0;
}

/* the embedded estimate of order 3, filtered by the Jacobian at the step's start */
static double estimate(Imposed *force, const Node *from, double h, const double *Z, const double *J0, double rtol, const double *atol, int cautious) {
    double matrix[NX * NX], known[NX], e[NX], x[NX], f[NX], V, W, W_dot;
    int pivot[NX];
    for (int r = 0; r < NX; r++) {
        for (int c = 0; c < NX; c++) matrix[r * NX + c] = (r == c ? U1 / h : 0.0) - J0[r * NX + c];
        known[r] = (E[0] * Z[r] + E[1] * Z[NX + r] + E[2] * Z[2 * NX + r]) / h;
        e[r] = known[r] + from->f[r];
    }
    if (!factor(NX, matrix, pivot)) return INFINITY;
    solve(NX, matrix, pivot, e, 1);
    double size = norm(e, from->x, rtol, atol);
    if (size >= 1.0 && cautious) {
        imposed(force, from->t, &V, &W, &W_dot);
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + e[r];
        memset(f, 0, sizeof f);
        srf_rates(x, V, W, W_dot, force->p, f);
        for (int r = 0; r < NX; r++) e[r] = known[r] + f[r];
        if (finite_all(e, NX)) {
            solve(NX, matrix, pivot, e, 1);
            size = norm(e, from->x, rtol, atol);
        }
    }
    return isfinite(size) ? fmax(size, 1e-10) : INFINITY;
}

/* S after the step: the linear equations of the stages with their converged Jacobians */
static int step_sensitivities(History *q, Imposed *force, const Node *from, double h, const double *Z) {
    int ns = q->ns, pivot[NZ];
    double matrix[NZ * NZ], J[3][NX * NX], P[NX * NP], x[NX], V, W, W_dot, *B = q->work;
    const double *S = q->S + (size_t)(q->nodes - 1) * NX * ns;
    double *G = B + (size_t)NZ * ns;
    for (int i = 0; i < 3; i++) {
        imposed(force, from->t + C[i] * h, &V, &W, &W_dot);
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
        memset(J[i], 0, sizeof J[i]);
        memset(P, 0, sizeof P);
        srf_jacobian(x, V, W, W_dot, force->p, J[i]);
        srf_parameters(x, V, W, W_dot, force->p, P);
        for (int r = 0; r < NX; r++)
            for (int k = 0; k < ns; k++) {
                double sum = q->which[k] < 0 ? 0.0 : P[r * NP + q->which[k]];
                for (int c = 0; c < NX; c++) sum += J[i][r * NX + c] * S[c * ns + k];
                G[((size_t)i * NX + r) * ns + k] = sum;
            }
    }
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < NX * ns; r++)
            B[(size_t)i * NX * ns + r] = h * (A[i][0] * G[r] + A[i][1] * G[(size_t)NX * ns + r] + A[i][2] * G[(size_t)2 * NX * ns + r]);
    if (!stage_matrix((const double(*)[NX * NX])J, h, matrix, pivot)) return 0;
    solve(NZ, matrix, pivot, B, ns);
    double *after = q->S + (size_t)q->nodes * NX * ns;
    for (int r = 0; r < NX * ns; r++) after[r] = S[r] + B[(size_t)2 * NX * ns + r];
    return finite_all(after, NX * ns);
}

/* the same estimate for the sensitivities, from the increments that step_sensitivities left in q->work; its largest norm */
static double estimate_sensitivities(const History *q, double h, const double *J0, double rtol, const double *atol) {
    int ns = q->ns, pivot[NX];
    double matrix[NX * NX], worst = 0.0, *B = q->work, *e = B + (size_t)NZ * ns;
    size_t size = (size_t)NX * ns;
    const double *S = q->S + (q->nodes - 1) * size, *F = q->Sf + (q->nodes - 1) * size;
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++) matrix[r * NX + c] = (r == c ? U1 / h : 0.0) - J0[r * NX + c];
    if (!factor(NX, matrix, pivot)) return INFINITY;
    for (size_t r = 0; r < size; r++) e[r] = (E[0] * B[r] + E[1] * B[size + r] + E[2] * B[2 * size + r]) / h + F[r];
    solve(NX, matrix, pivot, e, ns);
    for (int k = 0; k < ns; k++) {
        double sum = 0.0;
        for (int r = 0; r < NX; r++) {
            double x = S[r * ns + k], own = e[r * ns + k] / (SHARE * (atol[r] * q->scale[k] + rtol * fabs(x)));
            sum += own * own;
        }
        worst = fmax(worst, sum);
    }
    return isfinite(worst) ? sqrt(worst / NX) : INFINITY;
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

static double first_step(Imposed *force, const Node *n, double span, double rtol, const double *atol) {
    double x[NX], f[NX], d[NX], V, W, W_dot;
    double d0 = norm(n->x, n->x, rtol, atol), d1 = norm(n->f, n->x, rtol, atol);
    double h = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    h = fmin(h, span);
    for (int r = 0; r < NX; r++) x[r] = n->x[r] + h * n->f[r];
    memset(f, 0, sizeof f);
    imposed(force, n->t + h, &V, &W, &W_dot);
    srf_rates(x, V, W, W_dot, force->p, f);
    for (int r = 0; r < NX; r++) d[r] = (f[r] - n->f[r]) / h;
    double d2 = norm(d, n->x, rtol, atol), steepest = fmax(d1, d2);
    if (!isfinite(steepest)) return fmin(1e-9, span);
    double second = steepest <= 1e-15 ? fmax(1e-6, h * 1e-3) : pow(0.01 / steepest, 0.25);
    return fmin(fmin(100.0 * h, second), span);
}

/* integrates one smooth segment [a, b]; returns the next output index, or -1 - (it) where it stopped early */
static int segment(Imposed *force, History *q, double a, double b, double rtol, const double *atol, double longest, long max_steps, int next, int nt, const double *t, double *X, double *S, double *stats) {
    double V, W, W_dot, Z[NZ], Z0[NZ], J[3][NX * NX], J0[NX * NX], before = 0.0, last_error = 1.0, last_h = 0.0;
    int rejected = 0, first = 1;
    Node *now = &q->node[0];
    now->t = a;
    imposed(force, a, &V, &W, &W_dot);
    memset(now->f, 0, sizeof now->f);
    srf_rates(now->x, V, W, W_dot, force->p, now->f);
    q->nodes = 1;
    sensitivity_rates(q, 0, force);
    double h = fmin(first_step(force, now, b - a, rtol, atol), longest);
    while (now->t < b) {
        if (stats[0] + stats[1] >= max_steps) return -1 - next;
        double left = b - now->t;
        int final = h >= left * (1.0 - 1e-12);
        if (final) h = left;
        else if (2.0 * h > left) h = 0.5 * left;
        if (h < 4.0 * DBL_EPSILON * fmax(fabs(now->t), fabs(b)) && !final) return -1 - next;
        if (before > 0.0) predict(Z, before, h, Z0);
        else memset(Z0, 0, sizeof Z0);
        double kept[NZ];
        memcpy(kept, Z, before > 0.0 ? sizeof kept : 0);
        int newton = stages(force, now, h, Z0, rtol, atol, Z, J);
        if (!newton && before > 0.0) {
            memset(Z0, 0, sizeof Z0);
            newton = stages(force, now, h, Z0, rtol, atol, Z, J);
        }
        double error = INFINITY;
        if (newton) {
            imposed(force, now->t, &V, &W, &W_dot);
            memset(J0, 0, sizeof J0);
            srf_jacobian(now->x, V, W, W_dot, force->p, J0);
            error = estimate(force, now, h, Z, J0, rtol, atol, first || rejected);
            if (error < 1.0 && q->ns) {
                double other = step_sensitivities(q, force, now, h, Z) ? estimate_sensitivities(q, h, J0, rtol, atol) : INFINITY;
                error = fmax(error, other);
            }
        }
        stats[2] += newton ? newton : MAX_NEWTON;
        double safety = 0.9 * (2 * MAX_NEWTON + 1.0) / (2 * MAX_NEWTON + (newton ? newton : MAX_NEWTON));
        double factor_ = isfinite(error) ? fmin(8.0, fmax(0.2, safety * pow(error, -0.25))) : 0.25;
        if (!(error < 1.0)) {
            stats[1] += 1;
            memcpy(Z, kept, before > 0.0 ? sizeof kept : 0);
            h *= rejected || isinf(error) ? fmin(factor_, 0.5) : fmin(factor_, 0.9);
            rejected = 1;
            if (h < 1e-300) return -1 - next;
            continue;
        }
        Node after;
        after.t = final ? b : now->t + h;
        for (int r = 0; r < NX; r++) after.x[r] = now->x[r] + Z[2 * NX + r];
        memset(after.f, 0, sizeof after.f);
        imposed(force, after.t, &V, &W, &W_dot);
        srf_rates(after.x, V, W, W_dot, force->p, after.f);
        if (!finite_all(after.x, NX) || !finite_all(after.f, NX)) {
            h *= 0.25;
            rejected = 1;
            stats[1] += 1;
            before = 0.0;
            continue;
        }
        q->node[q->nodes] = after;
        q->nodes++;
        sensitivity_rates(q, q->nodes - 1, force);
        stats[0] += 1;
        if (q->nodes > 2) next = write_outputs(q, q->nodes - 3, next, nt, t, X, S);
        if (final) next = write_outputs(q, q->nodes - 2, next, nt, t, X, S);
        if (q->nodes == NODES && !final) drop_oldest(q);
        now = &q->node[q->nodes - 1];
        if (!first && last_h > 0.0) { /* predictive controller of Gustafsson */
            double predicted = safety * (h / last_h) * pow(error * error / last_error, -0.25);
            factor_ = fmin(factor_, fmax(0.2, fmin(8.0, predicted)));
        }
        last_error = fmax(error, 1e-2);
        last_h = h;
        if (rejected) factor_ = fmin(factor_, 1.0);
        before = h;
        h = fmin(h * factor_, longest);
        rejected = first = 0;
    }
    return next;
}

/* Returns how many output times were filled; stats: steps, rejected, Newton iterations, time reached.
   X (nt, NX), S (nt, NX, ns); column k of S belongs to parameter which[k], or to an initial condition where which[k] < 0.
   The output at t[0], the start, is the caller's. */
int srf_integrate(int n_segments, const double *edges, const double *drive, const int *range, int n_knots, int degree, const double *knots, const double *coefficients, const double *p, const double *x0, int ns, const int *which, const double *scale, const double *S0, double rtol, const double *atol, double longest, long max_steps, int nt, const double *t, double *X, double *S, double *stats) {
    Imposed force = {n_knots, degree, knots, coefficients, 0, 0, 0, 0.0, 0.0, 0.0, p};
    History q;
    size_t size = (size_t)NX * ns;
    int next = 0;
    double *block = NULL;
    memset(&q, 0, sizeof q);
    q.ns = ns;
    q.which = which;
    q.scale = scale;
    if (ns) {
        block = malloc((2 * NODES + 6) * size * sizeof(double));
        if (!block) return -1;
        q.S = block;
        q.Sf = block + NODES * size;
        q.work = block + 2 * NODES * size;
        memcpy(q.S, S0, size * sizeof(double));
    }
    memcpy(q.node[0].x, x0, NX * sizeof(double));
    while (next < nt && t[next] <= edges[0]) { /* the start itself */
        memcpy(X + (size_t)next * NX, x0, NX * sizeof(double));
        if (ns) memcpy(S + (size_t)next * size, S0, size * sizeof(double));
        next++;
    }
    stats[0] = stats[1] = stats[2] = 0.0;
    stats[3] = edges[0];
    for (int k = 0; k < n_segments; k++) {
        force.low = force.at = range[2 * k];
        force.high = range[2 * k + 1] - 1;
        force.V = drive[3 * k];
        force.acceleration = drive[3 * k + 1];
        force.since = drive[3 * k + 2];
        int done = segment(&force, &q, edges[k], edges[k + 1], rtol, atol, longest, max_steps, next, nt, t, X, S, stats);
        if (done < 0) {
            stats[3] = q.node[q.nodes - 1].t;
            free(block);
            return -1 - done;
        }
        next = done;
        stats[3] = edges[k + 1];
        q.node[0] = q.node[q.nodes - 1];
        if (ns) memmove(q.S, q.S + (size_t)(q.nodes - 1) * size, size * sizeof(double));
    }
    free(block);
    return next;
}
