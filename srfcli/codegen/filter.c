/* Continuous-discrete extended Kalman filter for one slider on a random friction field, with exact derivatives.

   Compiled behind radau.c and dual.c, for all models of NX states. A model has where the field's white noise enters the rates, and
   that, its rates, its gauge and the spring as it is, without the gauge's own lag, in dual numbers.
   The mean follows Radau IIA; the covariance follows the exact derivative of each of its steps, P -> Phi P Phi' + sum c c', where
   c are the responses to the MODES lowest Legendre polynomials of the white noise over the step. Where a reading moves the state so
   far that the equations are not linear, they are linearised again about the state before, as that reading corrects it (iterated
   linear filter-smoother). Everything is carried along in dual numbers, so that innovations and their variances have the derivatives
   of what was computed. Jazwinski, Stochastic Processes and Filtering Theory, 1970, chapter 8; Wishner, Tabaczynski and Athans,
   Automatica 5 (1969); Griewank and Walther, Evaluating Derivatives, 2008. */

MODEL void srf_gain(const double *x, double V, double W, double W_dot, const double *p, double *out); /* (NX) */
MODEL void srf_d_rates(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);
MODEL void srf_d_jacobian(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);
MODEL void srf_d_gain(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);
MODEL void srf_d_reading(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);          /* one number */
MODEL void srf_d_reading_gradient(const dual *x, double V, double W, double W_dot, const dual *p, dual *out); /* (NX) */
MODEL void srf_d_spring(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);
MODEL void srf_d_spring_gradient(const dual *x, double V, double W, double W_dot, const dual *p, dual *out);

#define MODES 3                             /* of white noise in a step; as many as stages can tell apart */
#define NA (NX + 2 * GAUGE_PROCESSES * SIGNALS) /* states with those of gauge noise, at most; matrices are laid out for those there are */
#define NC (NX + MODES)
typedef double quad __attribute__((vector_size(32), may_alias)); /* wider vectors are taken apart in memory; LANES is a multiple of 16 */
#define GAUGE -1
#define SPRING -2
#define NO_VARIANCE 1e150                   /* a variance that is none any more */
#define MANY 1000                           /* steps between two readings, after which their pace is looked at */
#define MAX_CORRECTION 4.0                  /* standard deviations of the states before a reading, by one of them */
#define SCANNED_STARTS 8                    /* to either side, as far as that */
#define UNLIKELY 9.0                        /* of a reading after them, three standard deviations: then others are tried */
#define RELINEARISATIONS 8                  /* between two readings, at most */

typedef struct {
    double x[NA], P[NA * NA], T[NA * NA];   /* mean and covariance of state and gauge noise; transition since the last sample */
    lanes xd[NA], Pd[NA * NA], Td[NA * NA];
} Belief;

typedef struct {
    const double *p;
    const dual *q;
    int slopes, keep, ng, na;               /* processes of gauge noise, of all signals; states with theirs */
    int mean_only, tangents;                /* the mean alone is moved; the transition's derivatives are taken */
    const int *order;                       /* how many states each of these has */
    double rtol, longest, h;                /* h: the step that the last one suggests */
    const double *atol;
    Control control;
    StageMatrix matrix;                     /* of the last step */
    long steps, rejected, max_steps;
    const volatile int *stop;
} Course;

static double legendre(int k, double s) {
    double y = 2.0 * s - 1.0;
    return k == 0 ? 1.0 : k == 1 ? sqrt(3.0) * y : sqrt(5.0) * 0.5 * (3.0 * y * y - 1.0);
}

/* how the end of a step answers to rates at each of its stages, out (NX, NZ): the last rows of the stages' inverse, times h A */
static void answers(const StageMatrix *matrix, double *out) {
    const double *a = matrix->a;
    for (int r = 0; r < NX; r++) {
        double w[NZ] = {0.0};
        w[AT(2, r)] = 1.0;
        for (int k = AT(2, r); k < NZ; k++) {
            if (w[k] == 0.0) continue;
            w[k] /= a[k * NZ + k];
            for (int i = k + 1; i < NZ; i++) w[i] -= a[k * NZ + i] * w[k];
        }
        for (int k = NZ - 1; k >= 0; k--) {
            if (w[k] == 0.0) continue;
            for (int i = 0; i < k; i++) w[i] -= a[k * NZ + i] * w[k];
        }
        for (int k = NZ - 1; k >= 0; k--) {
            double swap = w[k];
            w[k] = w[matrix->pivot[k]];
            w[matrix->pivot[k]] = swap;
        }
        for (int i = 0; i < 3; i++)
            for (int c = 0; c < NX; c++)
                out[r * NZ + i * NX + c] = matrix->h * (A[0][i] * w[AT(0, c)] + A[1][i] * w[AT(1, c)] + A[2][i] * w[AT(2, c)]);
    }
}

/* out (n) += k times x (n): derivatives lie one after the other, and are taken as plain numbers */
static inline void add_scaled(int n, double k, const void *x, void *out) {
    const double *from = x;
    double *to = out;
    for (int i = 0; i < n; i++) to[i] += k * from[i];
}

static int nonzero(const lanes *d) {
    int some = 0;
    for (int i = 0; i < LANES; i++) some |= (*d)[i] != 0.0;
    return some;
}

/* derivatives out (NX, na) of Phi times x (NX, na), whose own are xd */
static inline void step_derivatives(int na, const double *Phi, const lanes *dPhi, const double *x, const lanes *xd, lanes *out) {
    memset(out, 0, (size_t)NX * na * sizeof *out);
    for (int r = 0; r < NX; r++)
        for (int k = 0; k < NX; k++) {
            for (int c = 0; c < na; c++) add_scaled(LANES, x[k * na + c], dPhi + r * NC + k, out + r * na + c);
            add_scaled(na * LANES, Phi[r * NC + k], xd + k * na, out + r * na);
        }
}

/* whether there is nothing random about the states: no variance, and no noise of rate `gain` (3, NX) at any stage */
static int certain(const Course *course, const Belief *b, const double *gain) {
    int some = 0;
    for (int k = 0; k < 3 * NX; k++) some |= gain[k] != 0.0;
    for (int k = 0; k < NX * course->na; k++) some |= b->P[k] != 0.0;
    return !some;
}

/* the mean across a step, and its derivatives by what the stages answer to them, of `B` (3, NX, m) from column `at` on */
static void move_mean(const Course *course, Belief *b, const double *Z, const double *B, int m, int at) {
    for (int r = 0; r < NX; r++) {
        b->x[r] += Z[2 * NX + r];
        if (course->slopes) {
            lanes moved;
            memcpy(&moved, B + (2 * NX + r) * m + at, sizeof moved);
            b->xd[r] += moved;
        }
    }
}

/* Covariance and tangents across one step whose stages are solved; the mean is moved too. Returns the error of the covariance
   over what is allowed, by the share that the last polynomial has in the variances; nothing is changed unless it is below 1. */
static NOINLINE double moments(Imposed *force, Course *course, Belief *b, double t, double h, const double *Z) {
    int na = course->na;
    if (course->mean_only) {
        for (int r = 0; r < NX; r++) b->x[r] += Z[2 * NX + r];
        return 0.0;
    }
    double J[3][NX * NX], V[3], W[3], W_dot[3], x[3][NX], gain[3 * NX];
    double G[NZ * (NC + LANES)] __attribute__((aligned(64))), B[NZ * (NC + LANES)] __attribute__((aligned(64)));
    dual y[NX], f[NX];
    memset(gain, 0, sizeof gain);
    for (int i = 0; i < 3; i++) {
        imposed(force, t + C[i] * h, &V[i], &W[i], &W_dot[i]);
        for (int r = 0; r < NX; r++) x[i][r] = b->x[r] + Z[i * NX + r];
        srf_gain(x[i], V[i], W[i], W_dot[i], course->p, gain + i * NX);
    }
    int nc = course->keep || !certain(course, b, gain) ? NC : 0, m = nc + (course->slopes ? LANES : 0);
    if (!m) {
        move_mean(course, b, Z, NULL, 0, 0);
        return 0.0;
    }
    for (int i = 0; i < 3; i++) {
        memset(J[i], 0, sizeof J[i]);
        srf_jacobian(x[i], V[i], W[i], W_dot[i], course->p, J[i]);
        for (int r = 0; r < NX; r++) {
            double *g = G + (i * NX + r) * m;
            for (int c = 0; nc && c < NX; c++) g[c] = J[i][r * NX + c];
            for (int k = 0; nc && k < MODES; k++) g[NX + k] = gain[i * NX + r] * legendre(k, C[i]) / sqrt(h);
        }
        if (course->slopes) {
            for (int r = 0; r < NX; r++) y[r].v = x[i][r], y[r].d = b->xd[r];
            memset(f, 0, sizeof f);
            srf_d_rates(y, V[i], W[i], W_dot[i], course->q, f);
            for (int r = 0; r < NX; r++) memcpy(G + (i * NX + r) * m + nc, &f[r].d, sizeof(lanes));
        }
    }
    if (!stage_matrix(&course->matrix, (const double(*)[NX * NX])J, h)) return INFINITY;
    int rows = NX * m;
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < rows; r++) B[i * rows + r] = h * (A[i][0] * G[r] + A[i][1] * G[rows + r] + A[i][2] * G[2 * rows + r]);
    solve_stages(&course->matrix, B, m);
    if (!nc) {
        if (!finite_all(B, NZ * m)) return INFINITY;
        move_mean(course, b, Z, B, m, 0);
        return 0.0;
    }
    double Phi[NX * NC];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NC; c++) Phi[r * NC + c] = B[(2 * NX + r) * m + c] + (r == c ? 1.0 : 0.0);
    if (!finite_all(Phi, NX * NC)) return INFINITY;
    lanes dPhi[NX * NC];
    if (course->slopes) {
        int felt[NZ], n = 0;                /* rows whose rates have derivatives */
        double K[NX * NZ];
        lanes dG[NZ * NC];
        answers(&course->matrix, K);
        for (int i = 0; i < 3; i++) {
            dual dJ[NX * NX], dgain[NX];
            for (int r = 0; r < NX; r++) {
                lanes moved;
                memcpy(&moved, B + (i * NX + r) * m + NC, sizeof moved);
                y[r].v = b->x[r] + Z[i * NX + r];
                y[r].d = b->xd[r] + moved;
            }
            memset(dgain, 0, sizeof dgain);
            srf_d_jacobian(y, V[i], W[i], W_dot[i], course->q, dJ);
            srf_d_gain(y, V[i], W[i], W_dot[i], course->q, dgain);
            for (int r = 0, entry = 0; r < NX; r++) {
                lanes *out = dG + n * NC;
                int some = nonzero(&dgain[r].d);
                memset(out, 0, NC * sizeof *out);
                for (int k = 0; some && k < MODES; k++) add_scaled(LANES, legendre(k, C[i]) / sqrt(h), &dgain[r].d, out + NX + k);
                for (; entry < NJ && JACOBIAN[entry] / NX == r; entry++) {
                    int k = JACOBIAN[entry] % NX;
                    const lanes *slope = &dJ[JACOBIAN[entry]].d;
                    if (!nonzero(slope)) continue;
                    some = 1;
                    for (int c = 0; c < NC; c++) add_scaled(LANES, B[(i * NX + k) * m + c] + (k == c ? 1.0 : 0.0), slope, out + c);
                }
                if (some) felt[n++] = i * NX + r;
            }
        }
        for (int s = 0; s < NX; s++)
            for (int c = 0; c < NC; c++)
                for (int l = 0; l < LANES / 4; l += 4) { /* four sums at a time stay in registers */
                    quad first = {0.0}, second = {0.0}, third = {0.0}, fourth = {0.0}, *to = (quad *)(dPhi + s * NC + c) + l;
                    for (int k = 0; k < n; k++) {
                        double g = K[s * NZ + felt[k]];
                        const quad *from = (const quad *)(dG + k * NC + c) + l;
                        first += g * from[0], second += g * from[1], third += g * from[2], fourth += g * from[3];
                    }
                    to[0] = first, to[1] = second, to[2] = third, to[3] = fourth;
                }
    }
    double M[NX * NA], P[NX * NX];
    lanes dM[NX * NA], dT[NX * NA];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < na; c++) {
            double sum = 0.0, through = 0.0;
            for (int k = 0; k < NX; k++) sum += Phi[r * NC + k] * b->P[k * na + c], through += Phi[r * NC + k] * b->T[k * na + c];
            M[r * na + c] = sum;
            G[r * na + c] = through;
        }
    if (course->slopes) step_derivatives(na, Phi, dPhi, b->P, b->Pd, dM);
    if (course->tangents) step_derivatives(na, Phi, dPhi, b->T, b->Td, dT);
    for (int r = 0; r < NX; r++)
        for (int c = 0; c <= r; c++) {
            double sum = 0.0;
            for (int k = 0; k < NX; k++) sum += M[r * na + k] * Phi[c * NC + k];
            for (int k = NX; k < NC; k++) sum += Phi[r * NC + k] * Phi[c * NC + k];
            if (!(fabs(sum) < NO_VARIANCE)) return INFINITY;
            P[r * NX + c] = sum;
        }
    double share = 0.0;
    for (int r = 0; r < NX; r++) {
        double last = Phi[r * NC + NC - 1];
        if (last != 0.0) share = fmax(share, last * last / (P[r * NX + r] * course->rtol));
    }
    double error = pow(share, 0.8); /* of order 5 in h where the controller takes 4 */
    if (!(error < 1.0)) return error;
    move_mean(course, b, Z, B, m, NC);
    for (int r = 0; r < NX; r++) memcpy(b->T + r * na, G + r * na, na * sizeof(double));
    if (course->tangents) memcpy(b->Td, dT, (size_t)NX * na * sizeof(lanes));
    for (int r = 0; r < NX; r++) {
        for (int c = NX; c < na; c++) {
            b->P[r * na + c] = b->P[c * na + r] = M[r * na + c];
            if (course->slopes) b->Pd[r * na + c] = b->Pd[c * na + r] = dM[r * na + c];
        }
        for (int c = 0; c <= r; c++) {
            b->P[r * na + c] = b->P[c * na + r] = P[r * NX + c];
            if (course->slopes) {
                lanes slope = {0.0};
                for (int k = 0; k < NX; k++) {
                    add_scaled(LANES, Phi[c * NC + k], dM + r * na + k, &slope);
                    add_scaled(LANES, M[r * na + k], dPhi + c * NC + k, &slope);
                }
                for (int k = NX; k < NC; k++) {
                    add_scaled(LANES, Phi[c * NC + k], dPhi + r * NC + k, &slope);
                    add_scaled(LANES, Phi[r * NC + k], dPhi + c * NC + k, &slope);
                }
                b->Pd[r * na + c] = b->Pd[c * na + r] = slope;
            }
        }
    }
    return error;
}

/* carries the belief from a to b, between which all that is imposed is smooth; returns 0 where it stops early */
static NOINLINE int advance(Imposed *force, Course *course, Belief *belief, double a, double b) {
    Control *control = &course->control;
    double Z[NZ], J0[NX * NX], f0[NX], carry = 0.0;
    int unseen = 0;
    const long begun = course->steps + course->rejected;
    Node now;
    now.t = a;
    while (now.t < b) {
        long taken = course->steps + course->rejected - begun;
        if (taken > MANY && (now.t - a) * course->max_steps < (b - a) * taken) return 0; /* at this pace it never gets there */
        memcpy(now.x, belief->x, sizeof now.x);
        rates_at(force, now.t, now.x, now.f);
        memcpy(f0, now.f, sizeof f0);
        if (!finite_all(f0, NX)) return 0;
        if (!(course->h > 0.0)) course->h = fmin(first_step(force, &now, b - a, course->rtol, course->atol), course->longest);
        for (;;) {
            if (*course->stop || course->steps + course->rejected >= course->max_steps) return 0;
            double h = course->h;
            int final = fitted(&h, b - now.t);
            if (h < 4.0 * DBL_EPSILON * fmax(fabs(now.t), fabs(b)) && !final && ++unseen > MAX_UNSEEN) return 0;
            int newton = attempt(force, &now, h, control, 0, course->rtol, course->atol, Z, &course->matrix);
            int first = control->last_h == 0.0, rejected = control->rejected;
            double error = INFINITY;
            if (newton) {
                jacobian_at(force, now.t, now.x, J0);
                error = estimate(force, &now, f0, h, Z, J0, course->rtol, course->atol, first || rejected);
                if (error < 1.0) error = fmax(error, moments(force, course, belief, now.t, h, Z));
            }
            double next = next_length(control, h, error, newton);
            if (!(error < 1.0)) {
                course->rejected++;
                course->h = next;
                if (course->h < 1e-300 || !finite_all(belief->x, NX)) return 0;
                continue;
            }
            course->h = fmin(fmax(next, final && !rejected ? fmin(course->h, 8.0 * h) : 0.0), course->longest);
            memcpy(control->Z, Z, sizeof Z);
            control->before = h;
            course->steps++;
            now.t = time_after(now.t, h, b, final, &carry);
            break;
        }
    }
    return 1;
}

/* what a process of gauge noise does over dt, F (w, w). Of one state, e' = -e / tau + noise. Of two, an oscillator of frequency f and
   quality q, e'' + (omega / q) e' + omega^2 e = noise with omega = 2 pi f; its second state is e' / omega, so that both have the
   variance s^2. `gauge` holds tau, s or f, s, q. Foreman-Mackey, Agol, Ambikasaran and Angus, Astron. J. 154 (2017). */
static void gauge_step(int w, double dt, const dual *gauge, dual *F) {
    if (w == 1) {
        double e = exp(-dt / gauge[0].v);
        F[0] = srf_scaled(e, e * dt / (gauge[0].v * gauge[0].v), gauge[0]);
        return;
    }
    const dual f = gauge[0], q = gauge[2];
    const dual b = srf_mul_c(f, 6.283185307179586 * dt), a = srf_div(srf_mul_c(b, 0.5), q);
    const dual z = srf_sub(srf_mul(a, a), srf_mul(b, b));
    double c, s, s_z, root = sqrt(fabs(z.v)); /* exp(-a) times cosh(root), and times sinh(root) / root */
    if (fabs(z.v) < 1e-3) {
        double e = exp(-a.v);
        c = e * (1.0 + z.v * (1.0 / 2 + z.v * (1.0 / 24 + z.v / 720)));
        s = e * (1.0 + z.v * (1.0 / 6 + z.v * (1.0 / 120 + z.v / 5040)));
        s_z = e * (1.0 / 6 + z.v * (1.0 / 60 + z.v / 1680));
    } else {
        if (z.v > 0.0) {
            double slow = exp(-b.v * b.v / (a.v + root)), fast = exp(-a.v - root);
            c = 0.5 * (slow + fast);
            s = 0.5 * (slow - fast) / root;
        } else {
            c = exp(-a.v) * cos(root);
            s = exp(-a.v) * sin(root) / root;
        }
        s_z = 0.5 * (c - s) / z.v;
    }
    const dual C_ = {c, -c * a.d + 0.5 * s * z.d}, S_ = {s, -s * a.d + s_z * z.d};
    F[0] = srf_add(C_, srf_mul(a, S_));
    F[1] = srf_mul(b, S_);
    F[2] = srf_mul_c(F[1], -1.0);
    F[3] = srf_sub(C_, srf_mul(a, S_));
}

/* F times w numbers that lie `stride` apart */
static void gauge_turn(int w, const dual *F, double *v, lanes *d, int stride) {
    dual old[2], sum;
    for (int r = 0; r < w; r++) old[r].v = v[r * stride], old[r].d = d[r * stride];
    for (int r = 0; r < w; r++) {
        sum = srf_mul(F[r * w], old[0]);
        if (w == 2) sum = srf_add(sum, srf_mul(F[r * w + 1], old[1]));
        v[r * stride] = sum.v;
        d[r * stride] = sum.d;
    }
}

/* the processes of gauge noise over dt */
static void age_gauge(Course *course, Belief *b, double dt, const dual *gauge) {
    int na = course->na, at = NX;
    for (int j = 0; j < course->ng; j++) {
        int w = course->order[j];
        const dual s = gauge[3 * j + 1], variance = srf_mul(s, s);
        dual F[4];
        gauge_step(w, dt, gauge + 3 * j, F);
        gauge_turn(w, F, b->x + at, b->xd + at, 1);
        for (int c = 0; c < na; c++) gauge_turn(w, F, b->P + at * na + c, b->Pd + at * na + c, na);
        for (int c = 0; c < na; c++) gauge_turn(w, F, b->P + c * na + at, b->Pd + c * na + at, 1);
        for (int c = 0; c < na; c++) {
            double *T = b->T + at * na + c, old[2] = {T[0], w == 2 ? T[na] : 0.0};
            if (course->tangents) gauge_turn(w, F, T, b->Td + at * na + c, na);
            else
                for (int r = 0; r < w; r++) T[r * na] = F[r * w].v * old[0] + (w == 2 ? F[r * w + 1].v * old[1] : 0.0);
        }
        for (int r = 0; r < w; r++)
            for (int c = 0; c < w; c++) {
                dual kept = srf_mul(F[r * w], F[c * w]);
                if (w == 2) kept = srf_add(kept, srf_mul(F[r * w + 1], F[c * w + 1]));
                int own = (at + r) * na + at + c;
                const dual fresh = srf_mul(variance, srf_sub(srf_plain(r == c ? 1.0 : 0.0), kept));
                b->P[own] += fresh.v;
                b->Pd[own] += fresh.d;
            }
        at += w;
    }
}

/* the processes of gauge noise as they are where nothing was read yet */
static void fresh_gauge(Course *course, Belief *b, const dual *gauge) {
    static const lanes none = {0.0};
    int at = NX, na = course->na;
    for (int i = 0; i < na; i++)
        for (int g = NX; g < na; g++) {
            b->P[g * na + i] = b->P[i * na + g] = b->T[g * na + i] = b->T[i * na + g] = 0.0;
            b->Pd[g * na + i] = b->Pd[i * na + g] = none;
        }
    for (int j = 0; j < course->ng; j++) {
        const dual variance = srf_mul(gauge[3 * j + 1], gauge[3 * j + 1]);
        for (int r = 0; r < course->order[j]; r++, at++) {
            b->x[at] = 0.0;
            b->xd[at] = none;
            b->P[at * na + at] = variance.v;
            b->Pd[at * na + at] = variance.d;
        }
    }
}

/* all that is given of one run, as `srf_filter` has it */
typedef struct {
    int n_segments;
    const double *edges, *drive, *longest;
    const int *range;
    const double *t, *observed, *weighs, *factor, *offset, *R, *gauge;
    const int *rate, *signal, *shows;
    const unsigned char *used;
    const int *logarithm;
    const double *linear;
    int weighed, begins[NA];                /* 1 + the signal of the process whose first state this is, else 0 */
    double *values;
    dual *q;
} Recording;

/* where a run stands: what is imposed, and how the integration goes on */
typedef struct {
    Imposed force;
    Control control;
    double h, longest, now;
    int segment;
} Place;

/* what is expected of a reading: `there` at the state about which it is linearised, the mean unless that was shifted; by how much
   the tangent has the states `shifted` (NX); the reading's gradient H (na), covariances with it PH, innovation and variance */
typedef struct {
    dual there, noise, shifted[NX];
    double H[NA], PH[NA], miss, variance;
    lanes dH[NA], dPH[NA], dmiss, dvariance;
} Expected;

static const size_t wide = 1 + LANES;
#define TAKE(to, from) ((to).v = *(from), memcpy(&(to).d, (from) + 1, sizeof(lanes)))

static Place place(const Course *course, Place at) {
    at.control = course->control;
    at.h = course->h;
    at.longest = course->longest;
    return at;
}

static void resume(Course *course, const Place *from, Place *at) {
    *at = *from;
    course->control = from->control;
    course->h = from->h;
    course->longest = from->longest;
}

static void copy_belief(const Course *course, const Belief *from, Belief *to) {
    const size_t na = course->na;
    memcpy(to->x, from->x, na * sizeof(double));
    memcpy(to->P, from->P, na * na * sizeof(double));
    if (!course->slopes) return;
    memcpy(to->xd, from->xd, na * sizeof(lanes));
    memcpy(to->Pd, from->Pd, na * na * sizeof(lanes));
}

/* the transition since the last sample begins */
static void begin_transition(const Course *course, Belief *b) {
    const size_t na = course->na;
    memset(b->T, 0, na * na * sizeof(double));
    for (size_t i = 0; i < na; i++) b->T[i * na + i] = 1.0;
    if (course->tangents) memset(b->Td, 0, na * na * sizeof(lanes));
}

/* moves a belief on to a time; returns 0 where it stops early */
static int travel(const Recording *run, Place *at, Course *course, Belief *b, double to) {
    while (at->now < to || at->segment < 0) {
        int next = at->segment + 1;
        if (at->segment < 0 || (next < run->n_segments && at->now >= run->edges[next])) {
            at->segment = next;
            at->force.low = at->force.at = run->range[2 * next];
            at->force.high = run->range[2 * next + 1] - 1;
            at->force.V = run->drive[3 * next];
            at->force.acceleration = run->drive[3 * next + 1];
            at->force.since = run->drive[3 * next + 2];
            course->longest = run->longest[next];
            course->control.before = course->control.last_h = course->h = 0.0;
            continue;
        }
        double end = next < run->n_segments ? fmin(to, run->edges[next]) : to;
        if (!advance(&at->force, course, b, at->now, end)) return 0;
        at->now = end;
    }
    return 1;
}

/* moves a belief, gauge noise and all, on to a reading from the one before; returns 0 where it stops early */
static int reach(const Recording *run, int k, Place *at, Course *course, Belief *b) {
    dual colour[3 * GAUGE_PROCESSES * SIGNALS];
    if (!travel(run, at, course, b, run->t[k])) return 0;
    for (int i = 0; i < 3 * course->ng; i++) TAKE(colour[i], run->gauge + ((size_t)run->rate[k] * 3 * course->ng + i) * wide);
    if (!k || run->rate[k] != run->rate[k - 1]) fresh_gauge(course, b, colour);
    else if (run->t[k] > run->t[k - 1]) age_gauge(course, b, run->t[k] - run->t[k - 1], colour);
    return 1;
}

/* what a reading shows of the states, without its factor, and the gradient g (NX) unless that is NULL */
static dual shown(const Recording *run, int k, Place *at, const dual *y, dual *g) {
    double V, W, W_dot;
    dual out = srf_plain(0.0);
    if (g) memset(g, 0, NX * sizeof *g);
    if (run->shows[k] >= 0) {
        if (g) g[run->shows[k]].v = 1.0;
        return y[run->shows[k]];
    }
    imposed(&at->force, run->t[k], &V, &W, &W_dot);
    if (run->shows[k] == GAUGE) {
        srf_d_reading(y, V, W, W_dot, run->q, &out);
        if (g) srf_d_reading_gradient(y, V, W, W_dot, run->q, g);
        return out;
    }
    if (run->weighed >= 0) run->q[run->weighed].v = run->weighs[k];
    srf_d_spring(y, V, W, W_dot, run->q, &out);
    if (g) srf_d_spring_gradient(y, V, W, W_dot, run->q, g);
    if (run->weighed >= 0) run->q[run->weighed].v = run->values[run->weighed];
    return out;
}

/* what is expected of a reading under a belief whose mean was shifted by `shift` (NX) at the reading before, NULL if by nothing */
static void expect(const Recording *run, int k, Place *at, const Course *course, const Belief *b, const dual *shift, Expected *e) {
    const int na = course->na;
    dual y[NX], g[NX], scale, offset, linear;
    for (int i = 0; i < NX; i++) y[i].v = b->x[i], y[i].d = b->xd[i];
    TAKE(scale, run->factor + k * wide);
    TAKE(offset, run->offset + k * wide);
    TAKE(e->noise, run->R + k * wide);
    e->there = srf_add(srf_mul(scale, shown(run, k, at, y, g)), offset);
    for (int i = 0; i < na; i++) {
        int own = i >= NX && run->begins[i] == 1 + run->signal[k];
        dual slope = i < NX ? srf_mul(scale, g[i]) : srf_plain(own);
        e->H[i] = slope.v;
        e->dH[i] = slope.d;
        if (own) e->there.v += b->x[i], e->there.d += b->xd[i];
    }
    linear = e->there;
    for (int i = 0; shift && i < NX; i++) {
        e->shifted[i] = srf_plain(0.0);
        for (int j = 0; j < NX; j++) {
            e->shifted[i].v += b->T[i * na + j] * shift[j].v;
            if (course->slopes) e->shifted[i].d += b->T[i * na + j] * shift[j].d + b->Td[i * na + j] * shift[j].v;
        }
        linear.v -= e->H[i] * e->shifted[i].v;
        linear.d -= e->H[i] * e->shifted[i].d + e->dH[i] * e->shifted[i].v;
    }
    memset(e->PH, 0, sizeof e->PH);
    memset(e->dPH, 0, sizeof e->dPH);
    for (int i = 0; i < na; i++)
        for (int j = 0; j < na; j++) {
            e->PH[i] += b->P[i * na + j] * e->H[j];
            if (!course->slopes) continue;
            add_scaled(LANES, e->H[j], b->Pd + i * na + j, e->dPH + i);
            add_scaled(LANES, b->P[i * na + j], e->dH + j, e->dPH + i);
        }
    e->miss = run->observed[k] - linear.v;
    e->dmiss = -linear.d;
    e->variance = e->noise.v;
    e->dvariance = e->noise.d;
    for (int i = 0; i < na; i++) {
        e->variance += e->H[i] * e->PH[i];
        e->dvariance += e->dH[i] * e->PH[i] + e->H[i] * e->dPH[i];
    }
}

/* how a reading corrects the belief at the reading before: by how much it shifts the states there (NX), their covariances with what
   is there (na) times `by`; the reading to which the tangent then leads, and the variance of that if the shifted state were known */
typedef struct {
    dual shift[NX];
    double by[NA], ahead, variance, cost, off;
} Correction;

/* the correction of the belief `from` by the tangent at `shift` (NX), from where the belief came */
static void correct(const Course *course, const Belief *from, const Belief *b, const Expected *e, const dual *shift, Correction *c) {
    const int na = course->na;
    dual back[NA];
    for (int j = 0; j < na; j++) {
        back[j] = srf_plain(0.0);
        for (int l = 0; l < na; l++) {
            back[j].v += b->T[l * na + j] * e->H[l];
            if (course->tangents) back[j].d += b->T[l * na + j] * e->dH[l] + b->Td[l * na + j] * e->H[l];
        }
        c->by[j] = back[j].v * e->miss / e->variance;
    }
    c->ahead = e->there.v;
    c->variance = e->variance;
    for (int i = 0; i < na; i++) {
        dual sum = srf_plain(0.0);
        for (int j = 0; j < na; j++) {
            sum.v += from->P[i * na + j] * back[j].v;
            if (course->tangents) sum.d += from->P[i * na + j] * back[j].d + from->Pd[i * na + j] * back[j].v;
        }
        c->variance -= back[i].v * sum.v;
        if (i >= NX) continue;
        double gain = sum.v / e->variance;
        c->shift[i].v = gain * e->miss;
        c->shift[i].d = (sum.d - gain * e->dvariance) * (e->miss / e->variance) + gain * e->dmiss;
        c->ahead += back[i].v * (c->shift[i].v - shift[i].v);
    }
}

/* twice what a correction takes from the log density of the states before */
static double cost_of(const Course *course, const Belief *from, const double *by) {
    double sum = 0.0;
    for (int i = 0; i < course->na; i++)
        for (int j = 0; j < course->na; j++) sum += by[i] * from->P[i * course->na + j] * by[j];
    return sum;
}

/* whether a reading moves the states so far that where they come from by the equations is not where their tangent leads */
static int bent(const Recording *run, int k, const Place *was, Place *at, Course *course, Belief *from, const Belief *b, const Expected *e) {
    double farthest = 0.0, limit = run->linear[1] * sqrt(e->noise.v), read = NAN, kept[NX];
    dual none[NX], y[NX], scale;
    Correction c;
    if (!(fabs(e->miss) * (e->variance - e->noise.v) > limit * e->variance)) return 0;
    for (int i = 0; i < NX; i++)
        if (run->logarithm[i]) farthest = fmax(farthest, fabs(e->PH[i] * e->miss / e->variance));
    if (!(farthest > run->linear[0])) return 0;
    const Place then = place(course, *at);
    memset(none, 0, sizeof none);
    correct(course, from, b, e, none, &c);
    memcpy(kept, from->x, sizeof kept);
    for (int i = 0; i < NX; i++) from->x[i] += c.shift[i].v;
    resume(course, was, at);
    course->mean_only = 1;
    TAKE(scale, run->factor + k * wide);
    if (travel(run, at, course, from, run->t[k])) {
        for (int i = 0; i < NX; i++) y[i] = srf_plain(from->x[i]);
        read = shown(run, k, at, y, NULL).v;
        for (int i = 0; i < NX; i++) y[i] = srf_plain(b->x[i]);
        read = e->there.v + scale.v * (read - shown(run, k, at, y, NULL).v);
    }
    course->mean_only = 0;
    resume(course, &then, at);
    memcpy(from->x, kept, sizeof kept);
    return !(fabs(read - c.ahead) <= limit);
}

/* Gauss and Newton's method for the most probable state at the reading before, from `shift` (NX) of its mean, to which `by` (na) leads:
   until the next correction has what the tangent says of it, by a part of one where a whole one leads to what is less likely, or
   cannot be followed. Leaves belief and expectation there, and returns 1; 0 where the start cannot be followed. */
static int gauss_newton(const Recording *run, int k, const Place *was, Place *at, Course *course, const Belief *from, const dual *start, const double *led, Belief *b, Expected *e, Correction *best) {
    const double close = run->linear[1];
    Correction c;
    dual shift[NX];
    double by[NA];
    int partly = 0;
    memcpy(shift, start, sizeof shift);
    memcpy(by, led, course->na * sizeof *by);
    for (int turn = 0;; turn++) {
        const int last = turn > RELINEARISATIONS; /* at the likeliest, then */
        double likelier = -INFINITY;
        copy_belief(course, from, b);
        begin_transition(course, b);
        resume(course, was, at);
        for (int i = 0; i < NX; i++) b->x[i] += shift[i].v, b->xd[i] += shift[i].d;
        int found = reach(run, k, at, course, b);
        if (found) {
            expect(run, k, at, course, b, shift, e);
            found = e->variance > 0.0 && e->variance < NO_VARIANCE;
        }
        if (!found && (!turn || last || *course->stop)) return 0;
        if (found) {
            int there = turn && !partly && fabs(e->there.v - c.ahead) <= close * sqrt(e->noise.v);
            correct(course, from, b, e, shift, &c);
            c.off = run->observed[k] - e->there.v;
            c.cost = cost_of(course, from, by);
            /* one variance for both: beside a fall that of the tangent grows without end */
            double least = turn ? fmin(c.variance, best->variance) : c.variance;
            likelier = turn ? best->cost - c.cost + (best->off * best->off - c.off * c.off) / least : 0.0;
            if (there || last || (turn == RELINEARISATIONS && likelier >= 0.0)) {
                best->cost = c.cost, best->off = c.off, best->variance = c.variance;
                memcpy(best->shift, shift, sizeof shift);
                memcpy(best->by, by, sizeof by);
                return 1;
            }
        }
        if (turn == RELINEARISATIONS) {
            memcpy(shift, best->shift, sizeof shift);
            memcpy(by, best->by, sizeof by);
        } else if (likelier < 0.0) {
            partly = 1;
            for (int i = 0; i < NX; i++) shift[i] = srf_mul_c(srf_add(best->shift[i], shift[i]), 0.5);
            for (int i = 0; i < course->na; i++) by[i] = 0.5 * (best->by[i] + by[i]);
        } else {
            Correction next = c;
            for (int i = 0; i < course->na; i++) next.by[i] -= by[i];
            double far = sqrt(cost_of(course, from, next.by)), share = 1.0;
            while (share * far > MAX_CORRECTION) share *= 0.5; /* constant, for derivatives */
            partly = share < 1.0;
            memcpy(c.shift, shift, sizeof shift);
            memcpy(c.by, by, sizeof by);
            *best = c;
            for (int i = 0; i < NX; i++) shift[i] = srf_add(shift[i], srf_mul_c(srf_sub(next.shift[i], shift[i]), share));
            for (int i = 0; i < course->na; i++) by[i] += share * next.by[i];
        }
    }
}

/* Of shifts of the states at the reading before, which move the least certain logarithm by standard deviations and the others as they
   go with it, the likeliest, as `shift` (NX) and `by` (na). Returns 0 where none is likelier than `best`. */
static int likelier_start(const Recording *run, int k, const Place *was, Place *at, Course *course, Belief *from, const Belief *b, const Expected *e, const Correction *best, dual *shift, double *by) {
    double kept[NX], far = 0.0, lowest = best->cost + best->off * best->off / best->variance;
    int along = 0, na = course->na;
    dual y[NX], scale;
    for (int i = 0; i < NX; i++)
        if (run->logarithm[i] && from->P[i * na + i] > far) far = from->P[i * na + i], along = i;
    if (!(far > 0.0)) return 0;
    TAKE(scale, run->factor + k * wide);
    for (int i = 0; i < NX; i++) y[i] = srf_plain(b->x[i]);
    const double rest = e->there.v - scale.v * shown(run, k, at, y, NULL).v;
    const Place then = place(course, *at);
    memcpy(kept, from->x, sizeof kept);
    memset(by, 0, NA * sizeof *by);
    for (int side = -SCANNED_STARTS; side <= SCANNED_STARTS; side++) {
        double size = side * MAX_CORRECTION / SCANNED_STARTS;
        for (int i = 0; i < NX; i++) from->x[i] += size * from->P[i * na + along] / sqrt(far);
        resume(course, was, at);
        course->mean_only = 1;
        if (side && travel(run, at, course, from, run->t[k])) {
            for (int i = 0; i < NX; i++) y[i] = srf_plain(from->x[i]);
            double off = run->observed[k] - rest - scale.v * shown(run, k, at, y, NULL).v;
            double total = size * size + off * off / best->variance;
            if (total < lowest) {
                lowest = total;
                by[along] = size / sqrt(far);
            }
        }
        course->mean_only = 0;
        memcpy(from->x, kept, sizeof kept);
    }
    resume(course, &then, at);
    for (int i = 0; i < NX; i++) shift[i] = srf_plain(by[along] * from->P[i * na + along]);
    return by[along] != 0.0;
}

/* A belief at a reading, linearised about the most probable state before. Where that cannot be followed, the belief stays as it
   was. Returns 0 where it stops early. */
static int relinearise(const Recording *run, int k, const Place *was, Place *at, Course *course, Belief *from, Belief *b, Expected *e) {
    Correction best, other;
    dual shift[NX];
    double by[NA];
    memset(shift, 0, sizeof shift);
    memset(by, 0, sizeof by);
    course->tangents = course->slopes;
    int found = gauss_newton(run, k, was, at, course, from, shift, by, b, e, &best);
    if (found && best.cost + best.off * best.off / best.variance > UNLIKELY && likelier_start(run, k, was, at, course, from, b, e, &best, shift, by)) {
        found = gauss_newton(run, k, was, at, course, from, shift, by, b, e, &other);
        double least = fmin(best.variance, other.variance);
        if (!found || other.cost + other.off * other.off / least > best.cost + best.off * best.off / least)
            found = gauss_newton(run, k, was, at, course, from, best.shift, best.by, b, e, &other);
    }
    course->tangents = 0;
    if (found) {
        for (int i = 0; i < NX; i++) b->x[i] -= e->shifted[i].v, b->xd[i] -= e->shifted[i].d;
        return 1;
    }
    copy_belief(course, from, b);
    begin_transition(course, b);
    resume(course, was, at);
    if (!reach(run, k, at, course, b)) return 0;
    expect(run, k, at, course, b, NULL, e);
    return 1;
}

/* One run: innovations nu (nt), their variances S (nt) and the derivatives of both (nt, LANES), at the readings where `used`; all
   get the mean (nt, na), covariance (nt, na, na), transition (nt, na, na) from the reading before and the reading's gradient (nt,
   na), before they are used, and how states follow it (nt, na), where those are wanted. Several signals may be read at one time: `t` (nt) does not fall, and `signal` (nt) says which it is. A reading is `factor` times what it `shows` (nt) plus
   offset plus gauge noise of variance R: GAUGE the elongation as the gauge has it, SPRING as it is, where spring weighs by
   `weighs` (nt), 0 or 1, with which parameter `weighed` is replaced (-1 for none); from 0 on a state. The processes of coloured
   noise have `order` (ng) states each, belong to the signal `owner` (ng), and have parameters gauge (rates, ng, 3); which of the
   rates holds at a reading is `rate` (nt): where it changes, a noise begins that owes nothing to the one before. The states that are logarithms are those where `logarithm` (NX) is 1; `linear` (2) says how
   far a reading may move them, and how much a reading over its white noise may then differ from its tangent, before the equations are
   linearised again. p holds dual numbers
   (NP, 1 + LANES), x0 (NX, 1 + LANES) and P0 (NX, NX, 1 + LANES) too, as do gauge, factor, offset and R (nt). Returns how many readings were reached, and the
   `steps` of integration that it took. */
int srf_filter(int n_segments, const double *edges, const double *drive, const int *range, const double *longest, int n_knots, int degree, const double *knots, const double *coefficients, const double *p, const double *x0, const double *P0, int ng, const int *order, const int *owner, const double *gauge, const int *rate, const int *signal, const int *shows, const double *weighs, int weighed, int slopes, double rtol, const double *atol, long max_steps, int nt, const double *t, const double *observed, const unsigned char *used, const double *factor, const double *offset, const double *R, const int *logarithm, const double *linear, int keep, double *nu, double *S, double *nu_d, double *S_d, double *mean, double *covariance, double *transition, double *gradient, double *gains, double *steps, const volatile int *stop) {
    double values[NP];
    dual q[NP], one;
    Course course = {values, q, slopes, keep, ng, NX, 0, 0, order, rtol, 0.0, 0.0, atol, {{0.0}, 0.0, 0.0, 0.0, 0}, {{0.0}, 0.0, {0}}, 0, 0, max_steps, stop};
    Recording run = {n_segments, edges, drive, longest, range, t, observed, weighs, factor, offset, R, gauge, rate, signal, shows, used, logarithm, linear, weighed, {0}, values, q};
    Place at = {{n_knots, degree, knots, coefficients, 0, 0, 0, 0.0, 0.0, 0.0, values}, {{0.0}, 0.0, 0.0, 0.0, 0}, 0.0, 0.0, t[0], -1};
    Belief b, from;
    Expected e;
    int na, filled = 0;
    memset(&b, 0, sizeof b);
    for (int i = 0; i < NP; i++) TAKE(q[i], p + i * wide), values[i] = q[i].v;
    for (int j = 0; j < ng; j++) run.begins[course.na] = 1 + owner[j], course.na += order[j];
    na = course.na;
    for (int i = 0; i < NX; i++) TAKE(one, x0 + i * wide), b.x[i] = one.v, b.xd[i] = one.d;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) TAKE(one, P0 + (i * NX + j) * wide), b.P[i * na + j] = one.v, b.Pd[i * na + j] = one.d;
    for (int k = 0; k < nt; k++) {
        const Place was = place(&course, at);
        const int interval = k && used[k] && t[k] > t[k - 1];
        if (interval) copy_belief(&course, &b, &from);
        begin_transition(&course, &b);
        if (!reach(&run, k, &at, &course, &b)) goto end;
        expect(&run, k, &at, &course, &b, NULL, &e);
        if (interval && bent(&run, k, &was, &at, &course, &from, &b, &e) && !relinearise(&run, k, &was, &at, &course, &from, &b, &e))
            goto end;
        nu[k] = e.miss;
        S[k] = e.variance;
        memcpy(nu_d + (size_t)k * LANES, &e.dmiss, sizeof e.dmiss);
        memcpy(S_d + (size_t)k * LANES, &e.dvariance, sizeof e.dvariance);
        if (keep) {
            memcpy(mean + (size_t)k * na, b.x, na * sizeof(double));
            memcpy(gradient + (size_t)k * na, e.H, na * sizeof(double));
            memset(gains + (size_t)k * na, 0, na * sizeof(double));
            memcpy(covariance + (size_t)k * na * na, b.P, (size_t)na * na * sizeof(double));
            memcpy(transition + (size_t)k * na * na, b.T, (size_t)na * na * sizeof(double));
        }
        filled = k + 1;
        if (!used[k] || !(e.variance > 0.0)) continue;
        for (int i = 0; i < na; i++) {
            double gain = e.PH[i] / e.variance, move = gain * e.miss;
            lanes dgain = (e.dPH[i] - gain * e.dvariance) / e.variance, dmove = dgain * e.miss + gain * e.dmiss;
            if (slopes) {
                for (int j = 0; j < na; j++) add_scaled(LANES, -e.PH[j], &dgain, b.Pd + i * na + j);
                add_scaled(na * LANES, -gain, e.dPH, b.Pd + i * na);
            }
            for (int j = 0; j < na; j++) b.P[i * na + j] -= gain * e.PH[j];
            if (keep) gains[(size_t)k * na + i] = gain;
            b.xd[i] += dmove;
            b.x[i] += move;
        }
    }
end:
    *steps = course.steps;
    return filled;
}
