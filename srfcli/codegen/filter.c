/* Continuous-discrete extended Kalman filter for one slider on a random friction field, with exact derivatives.

   Compiled behind radau.c with a model that has such a field:
     srf_gain(x, V, W, W_dot, p, out[NX])        where the field's white noise enters the rates
     srf_d_rates, srf_d_jacobian, srf_d_gain, srf_d_reading, srf_d_gradient      the same and the gauge in dual numbers
   The mean follows Radau IIA; the covariance follows the exact derivative of each of its steps, P -> Phi P Phi' + sum c c', where
   c are the responses to the MODES lowest Legendre polynomials of the white noise over the step. Everything is carried along in
   dual numbers, so that innovations and their variances have the derivatives of what was computed.
   Jazwinski, Stochastic Processes and Filtering Theory, 1970; Griewank and Walther, Evaluating Derivatives, 2008. */

#define MODES 3                             /* of white noise in a step; as many as stages can tell apart */
#define NG 3                                /* processes of coloured gauge noise, at most */
#define NA (NX + NG)
#define NC (NX + MODES)
#define UNSTABLE 1e150                      /* a variance that is none any more */

typedef struct {
    double x[NA], P[NA * NA], T[NA * NA];   /* mean and covariance of state and gauge noise; transition since the last sample */
    lanes xd[NA], Pd[NA * NA];
} Belief;

typedef struct {
    const double *p;
    const dual *q;
    int slopes, ng;
    double rtol, longest, h;                /* h: the step that the last one suggests */
    const double *atol;
    double Z[NZ], before;                   /* increments and length of the last step, 0 for none */
    double last_error, last_h;
    int first;
    long steps, rejected, max_steps;
    const volatile int *stop;
} Course;

static double legendre(int k, double s) {
    double y = 2.0 * s - 1.0;
    return k == 0 ? 1.0 : k == 1 ? sqrt(3.0) * y : sqrt(5.0) * 0.5 * (3.0 * y * y - 1.0);
}

/* Covariance and tangents across one step whose stages are solved; the mean is moved too. Returns the error of the covariance
   over what is allowed, by the share that the last polynomial has in the variances; nothing is changed unless it is below 1. */
static double moments(Imposed *force, Course *course, Belief *b, double t, double h, const double *Z) {
    int m = NC + (course->slopes ? LANES : 0), pivot[NZ];
    double J[3][NX * NX], V[3], W[3], W_dot[3], x[NX], gain[NX], matrix[NZ * NZ];
    double G[NZ * (NC + LANES)], B[NZ * (NC + LANES)];
    dual y[NX], f[NX];
    for (int i = 0; i < 3; i++) {
        imposed(force, t + C[i] * h, &V[i], &W[i], &W_dot[i]);
        for (int r = 0; r < NX; r++) x[r] = b->x[r] + Z[i * NX + r];
        memset(J[i], 0, sizeof J[i]);
        memset(gain, 0, sizeof gain);
        srf_jacobian(x, V[i], W[i], W_dot[i], course->p, J[i]);
        srf_gain(x, V[i], W[i], W_dot[i], course->p, gain);
        for (int r = 0; r < NX; r++) {
            double *g = G + (i * NX + r) * m;
            for (int c = 0; c < NX; c++) g[c] = J[i][r * NX + c];
            for (int k = 0; k < MODES; k++) g[NX + k] = gain[r] * legendre(k, C[i]) / sqrt(h);
        }
        if (course->slopes) {
            for (int r = 0; r < NX; r++) y[r].v = x[r], y[r].d = b->xd[r];
            memset(f, 0, sizeof f);
            srf_d_rates(y, V[i], W[i], W_dot[i], course->q, f);
            for (int r = 0; r < NX; r++) memcpy(G + (i * NX + r) * m + NC, &f[r].d, sizeof(lanes));
        }
    }
    if (!stage_matrix((const double(*)[NX * NX])J, h, matrix, pivot)) return INFINITY;
    int rows = NX * m;
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < rows; r++) B[i * rows + r] = h * (A[i][0] * G[r] + A[i][1] * G[rows + r] + A[i][2] * G[2 * rows + r]);
    solve(NZ, matrix, pivot, B, m);
    double Phi[NX * NC];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NC; c++) Phi[r * NC + c] = B[(2 * NX + r) * m + c] + (r == c ? 1.0 : 0.0);
    if (!finite_all(Phi, NX * NC)) return INFINITY;
    static const lanes none = {0.0};
    lanes dG[NZ * NC], dB[NZ * NC], *dPhi = dB + 2 * NX * NC;
    if (course->slopes) {
        for (int i = 0; i < 3; i++) {
            dual dJ[NX * NX], dgain[NX];
            for (int r = 0; r < NX; r++) {
                lanes moved;
                memcpy(&moved, B + (i * NX + r) * m + NC, sizeof moved);
                y[r].v = b->x[r] + Z[i * NX + r];
                y[r].d = b->xd[r] + moved;
            }
            memset(dJ, 0, sizeof dJ);
            memset(dgain, 0, sizeof dgain);
            srf_d_jacobian(y, V[i], W[i], W_dot[i], course->q, dJ);
            srf_d_gain(y, V[i], W[i], W_dot[i], course->q, dgain);
            for (int r = 0; r < NX; r++)
                for (int c = 0; c < NC; c++) {
                    lanes sum = none;
                    if (c >= NX) sum = dgain[r].d * (legendre(c - NX, C[i]) / sqrt(h));
                    for (int k = 0; k < NX; k++) sum += dJ[r * NX + k].d * (B[(i * NX + k) * m + c] + (k == c ? 1.0 : 0.0));
                    dG[(i * NX + r) * NC + c] = sum;
                }
        }
        for (int i = 0; i < 3; i++)
            for (int r = 0; r < NX * NC; r++)
                dB[i * NX * NC + r] = (h * A[i][0]) * dG[r] + (h * A[i][1]) * dG[NX * NC + r] + (h * A[i][2]) * dG[2 * NX * NC + r];
        solve(NZ, matrix, pivot, (double *)dB, NC * LANES);
    }
    double M[NX * NA], P[NX * NX];
    lanes dM[NX * NA];
    int na = NX + course->ng;
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < na; c++) {
            double sum = 0.0, through = 0.0;
            for (int k = 0; k < NX; k++) sum += Phi[r * NC + k] * b->P[k * NA + c], through += Phi[r * NC + k] * b->T[k * NA + c];
            M[r * NA + c] = sum;
            G[r * NA + c] = through;
            if (course->slopes) {
                lanes slope = none;
                for (int k = 0; k < NX; k++) slope += dPhi[r * NC + k] * b->P[k * NA + c] + Phi[r * NC + k] * b->Pd[k * NA + c];
                dM[r * NA + c] = slope;
            }
        }
    for (int r = 0; r < NX; r++)
        for (int c = 0; c <= r; c++) {
            double sum = 0.0;
            for (int k = 0; k < NX; k++) sum += M[r * NA + k] * Phi[c * NC + k];
            for (int k = NX; k < NC; k++) sum += Phi[r * NC + k] * Phi[c * NC + k];
            if (!(fabs(sum) < UNSTABLE)) return INFINITY;
            P[r * NX + c] = sum;
        }
    double share = 0.0;
    for (int r = 0; r < NX; r++) {
        double last = Phi[r * NC + NC - 1];
        if (last != 0.0) share = fmax(share, last * last / (P[r * NX + r] * course->rtol));
    }
    double error = pow(share, 0.8); /* of order 5 in h where the controller takes 4 */
    if (!(error < 1.0)) return error;
    for (int r = 0; r < NX; r++) {
        b->x[r] += Z[2 * NX + r];
        if (course->slopes) {
            lanes moved;
            memcpy(&moved, B + (2 * NX + r) * m + NC, sizeof moved);
            b->xd[r] += moved;
        }
        memcpy(b->T + r * NA, G + r * NA, na * sizeof(double));
    }
    for (int r = 0; r < NX; r++) {
        for (int c = NX; c < na; c++) {
            b->P[r * NA + c] = b->P[c * NA + r] = M[r * NA + c];
            if (course->slopes) b->Pd[r * NA + c] = b->Pd[c * NA + r] = dM[r * NA + c];
        }
        for (int c = 0; c <= r; c++) {
            b->P[r * NA + c] = b->P[c * NA + r] = P[r * NX + c];
            if (course->slopes) {
                lanes slope = none;
                for (int k = 0; k < NX; k++) slope += dM[r * NA + k] * Phi[c * NC + k] + M[r * NA + k] * dPhi[c * NC + k];
                for (int k = NX; k < NC; k++) slope += dPhi[r * NC + k] * Phi[c * NC + k] + Phi[r * NC + k] * dPhi[c * NC + k];
                b->Pd[r * NA + c] = b->Pd[c * NA + r] = slope;
            }
        }
    }
    return error;
}

/* carries the belief from a to b, between which all that is imposed is smooth; returns 0 where it stops early */
static int advance(Imposed *force, Course *course, Belief *belief, double a, double b) {
    double V, W, W_dot, Z[NZ], Z0[NZ], J[3][NX * NX], J0[NX * NX], f0[NX], carry = 0.0;
    int rejected = 0, unseen = 0, first = course->first;
    Node now;
    now.t = a;
    while (now.t < b) {
        memcpy(now.x, belief->x, sizeof now.x);
        imposed(force, now.t, &V, &W, &W_dot);
        memset(now.f, 0, sizeof now.f);
        srf_rates(now.x, V, W, W_dot, course->p, now.f);
        memcpy(f0, now.f, sizeof f0);
        if (!finite_all(f0, NX)) return 0;
        if (!(course->h > 0.0)) course->h = fmin(first_step(force, &now, b - a, course->rtol, course->atol), course->longest);
        for (;;) {
            if (*course->stop || course->steps + course->rejected >= course->max_steps) return 0;
            double left = b - now.t, h = course->h;
            int final = h >= left * (1.0 - 1e-12);
            if (final) h = left;
            else if (2.0 * h > left) h = 0.5 * left;
            if (h < 4.0 * DBL_EPSILON * fmax(fabs(now.t), fabs(b)) && !final && ++unseen > MAX_UNSEEN) return 0;
            if (course->before > 0.0) predict(course->Z, course->before, h, Z0);
            else memset(Z0, 0, sizeof Z0);
            int newton = stages(force, &now, h, Z0, course->rtol, course->atol, Z, J);
            if (!newton && course->before > 0.0) {
                memset(Z0, 0, sizeof Z0);
                newton = stages(force, &now, h, Z0, course->rtol, course->atol, Z, J);
            }
            double error = INFINITY;
            if (newton) {
                imposed(force, now.t, &V, &W, &W_dot);
                memset(J0, 0, sizeof J0);
                srf_jacobian(now.x, V, W, W_dot, course->p, J0);
                error = estimate(force, &now, f0, h, Z, J0, course->rtol, course->atol, first || rejected);
                if (error < 1.0) error = fmax(error, moments(force, course, belief, now.t, h, Z));
            }
            double safety = 0.9 * (2 * MAX_NEWTON + 1.0) / (2 * MAX_NEWTON + (newton ? newton : MAX_NEWTON));
            double factor_ = isfinite(error) ? fmin(8.0, fmax(0.2, safety * pow(error, -0.25))) : 0.25;
            if (!(error < 1.0)) {
                course->rejected++;
                course->h = h * (rejected || isinf(error) ? fmin(factor_, 0.5) : fmin(factor_, 0.9));
                rejected = 1;
                if (course->h < 1e-300 || !finite_all(belief->x, NX)) return 0;
                continue;
            }
            double ahead = h + carry, after = final ? b : now.t + ahead;
            carry = final ? 0.0 : ahead - (after - now.t);
            if (!first && course->last_h > 0.0) { /* predictive controller of Gustafsson */
                double predicted = safety * (h / course->last_h) * pow(error * error / course->last_error, -0.25);
                factor_ = fmin(factor_, fmax(0.2, fmin(8.0, predicted)));
            }
            course->last_error = fmax(error, 1e-2);
            course->last_h = h;
            if (rejected) factor_ = fmin(factor_, 1.0);
            course->h = fmin(fmax(h * factor_, final && !rejected ? fmin(course->h, 8.0 * h) : 0.0), course->longest);
            memcpy(course->Z, Z, sizeof Z);
            course->before = h;
            course->steps++;
            course->first = first = rejected = 0;
            now.t = after;
            break;
        }
    }
    return 1;
}

/* the processes of gauge noise over dt: e' = -e / tau + s sqrt(2 / tau) w */
static void age_gauge(Course *course, Belief *b, double dt, const dual *gauge) {
    int na = NX + course->ng;
    dual decay[NG];
    for (int j = 0; j < course->ng; j++) {
        const dual tau = gauge[2 * j], s = gauge[2 * j + 1];
        double e = exp(-dt / tau.v);
        decay[j] = srf_scaled(e, e * dt / (tau.v * tau.v), tau);
        b->xd[NX + j] = b->xd[NX + j] * e + b->x[NX + j] * decay[j].d;
        b->x[NX + j] *= e;
        for (int c = 0; c < na; c++) b->T[(NX + j) * NA + c] *= e;
        for (int c = 0; c < na; c++)
            for (int side = 0; side < 2; side++) { /* its row, then its column */
                int at = side ? c * NA + NX + j : (NX + j) * NA + c;
                b->Pd[at] = b->Pd[at] * e + b->P[at] * decay[j].d;
                b->P[at] *= e;
            }
        int own = (NX + j) * NA + NX + j;
        double fresh = -expm1(-2.0 * dt / tau.v);
        b->P[own] += s.v * s.v * fresh;
        b->Pd[own] += 2.0 * s.v * fresh * s.d - s.v * s.v * 2.0 * e * decay[j].d;
    }
}

/* One run: innovations nu (nt), their variances S (nt) and the derivatives of both (nt, LANES), at the samples where `used`; all
   samples get the mean (nt, NA), covariance (nt, NA, NA), transition (nt, NA, NA) from the last sample and the reading's gradient
   (nt, NA), before they are used, where those are wanted (`keep`). The reading is `factor` times elongation plus offset plus gauge
   noise of variance R. p holds dual numbers (NP, 1 + LANES), x0 (NX, 1 + LANES) and P0 (NX, NX, 1 + LANES) too, as do gauge (ng, 2),
   factor, offset and R (nt). Returns how many samples were reached; stats: steps, rejected. */
int srf_filter(int n_segments, const double *edges, const double *drive, const int *range, int n_knots, int degree, const double *knots, const double *coefficients, const double *p, const double *x0, const double *P0, int ng, const double *gauge, int slopes, double rtol, const double *atol, double longest, long max_steps, int nt, const double *t, const double *observed, const unsigned char *used, const double *factor, const double *offset, const double *R, int keep, double *nu, double *S, double *nu_d, double *S_d, double *mean, double *covariance, double *transition, double *gradient, double *stats, const volatile int *stop) {
    double values[NP];
    dual q[NP], colour[2 * NG], y[NX], one, g[NX];
    Imposed force = {n_knots, degree, knots, coefficients, 0, 0, 0, 0.0, 0.0, 0.0, values};
    Course course = {values, q, slopes, ng, rtol, longest, 0.0, atol, {0.0}, 0.0, 1.0, 0.0, 1, 0, 0, max_steps, stop};
    Belief b;
    int na = NX + ng, segment_ = -1, filled = 0;
    double now = t[0], last = t[0];
    const size_t wide = 1 + LANES;
#define TAKE(to, from) ((to).v = *(from), memcpy(&(to).d, (from) + 1, sizeof(lanes)))
    memset(&b, 0, sizeof b);
    for (int i = 0; i < NP; i++) TAKE(q[i], p + i * wide), values[i] = q[i].v;
    for (int i = 0; i < 2 * ng; i++) TAKE(colour[i], gauge + i * wide);
    for (int i = 0; i < NX; i++) TAKE(one, x0 + i * wide), b.x[i] = one.v, b.xd[i] = one.d;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) TAKE(one, P0 + (i * NX + j) * wide), b.P[i * NA + j] = one.v, b.Pd[i * NA + j] = one.d;
    for (int j = 0; j < ng; j++) {
        int own = (NX + j) * NA + NX + j;
        b.P[own] = colour[2 * j + 1].v * colour[2 * j + 1].v;
        b.Pd[own] = 2.0 * colour[2 * j + 1].v * colour[2 * j + 1].d;
    }
    for (int i = 0; i < na; i++) b.T[i * NA + i] = 1.0;
    for (int k = 0; k < nt; k++) {
        while (now < t[k] || segment_ < 0) {
            if (segment_ < 0 || (segment_ + 1 < n_segments && now >= edges[segment_ + 1])) {
                segment_++;
                force.low = force.at = range[2 * segment_];
                force.high = range[2 * segment_ + 1] - 1;
                force.V = drive[3 * segment_];
                force.acceleration = drive[3 * segment_ + 1];
                force.since = drive[3 * segment_ + 2];
                course.before = 0.0;
                course.h = 0.0;
                course.first = 1;
                continue;
            }
            double to = segment_ + 1 < n_segments ? fmin(t[k], edges[segment_ + 1]) : t[k];
            if (!advance(&force, &course, &b, now, to)) goto end;
            now = to;
        }
        if (k) age_gauge(&course, &b, t[k] - last, colour);
        last = t[k];
        double V, W, W_dot, PH[NA], H[NA];
        lanes dPH[NA], dH[NA];
        static const lanes none = {0.0};
        dual reading, scale, shift, noise;
        imposed(&force, t[k], &V, &W, &W_dot);
        for (int i = 0; i < NX; i++) y[i].v = b.x[i], y[i].d = b.xd[i];
        memset(g, 0, sizeof g);
        memset(&reading, 0, sizeof reading);
        srf_d_reading(y, V, W, W_dot, q, &reading);
        srf_d_gradient(y, V, W, W_dot, q, g);
        TAKE(scale, factor + k * wide);
        TAKE(shift, offset + k * wide);
        TAKE(noise, R + k * wide);
        reading = srf_add(srf_mul(scale, reading), shift);
        for (int i = 0; i < na; i++) {
            one = i < NX ? srf_mul(scale, g[i]) : srf_plain(1.0);
            H[i] = one.v;
            dH[i] = one.d;
            if (i >= NX) reading.v += b.x[i], reading.d += b.xd[i];
        }
        for (int i = 0; i < na; i++) {
            PH[i] = 0.0;
            dPH[i] = none;
            for (int j = 0; j < na; j++) {
                PH[i] += b.P[i * NA + j] * H[j];
                dPH[i] += b.Pd[i * NA + j] * H[j] + b.P[i * NA + j] * dH[j];
            }
        }
        double variance = noise.v, miss = observed[k] - reading.v;
        lanes dvariance = noise.d, dmiss = -reading.d;
        for (int i = 0; i < na; i++) {
            variance += H[i] * PH[i];
            dvariance += dH[i] * PH[i] + H[i] * dPH[i];
        }
        nu[k] = miss;
        S[k] = variance;
        memcpy(nu_d + (size_t)k * LANES, &dmiss, sizeof dmiss);
        memcpy(S_d + (size_t)k * LANES, &dvariance, sizeof dvariance);
        if (keep) {
            for (int i = 0; i < na; i++) mean[(size_t)k * NA + i] = b.x[i], gradient[(size_t)k * NA + i] = H[i];
            memcpy(covariance + (size_t)k * NA * NA, b.P, sizeof b.P);
            memcpy(transition + (size_t)k * NA * NA, b.T, sizeof b.T);
        }
        filled = k + 1;
        memset(b.T, 0, sizeof b.T);
        for (int i = 0; i < na; i++) b.T[i * NA + i] = 1.0;
        if (!used[k] || !(variance > 0.0)) continue;
        for (int i = 0; i < na; i++) {
            double gain = PH[i] / variance;
            lanes dgain = (dPH[i] - gain * dvariance) / variance;
            for (int j = 0; j < na; j++) {
                b.Pd[i * NA + j] -= dgain * PH[j] + gain * dPH[j];
                b.P[i * NA + j] -= gain * PH[j];
            }
            b.xd[i] += dgain * miss + gain * dmiss;
            b.x[i] += gain * miss;
        }
    }
end:
    stats[0] = course.steps;
    stats[1] = course.rejected;
    return filled;
}
