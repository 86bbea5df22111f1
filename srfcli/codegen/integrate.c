/* Motion in time from one output to the next, with the exact derivatives of its discrete solution by parameters and initial state.

   Compiled behind radau.c, with dop853.c behind it, for all models of NX states and NT tables.
   Output between steps by the quintic Hermite polynomial through three nodes. One more factorisation with the converged Jacobians
   of the stages differentiates the step exactly. */

MODEL void srf_parameters(const double *x, double V, double W, double W_dot, const double *p, double *out); /* (NX, NP) */
#ifdef NT
MODEL void srf_table_arguments(const double *x, double V, double W, double W_dot, const double *p, double *out); /* (NT) */
MODEL void srf_rates_tables(const double *x, double V, double W, double W_dot, const double *p, double *out); /* (NX, 2 NT) */
#endif

#define SHARE 30.0                          /* sensitivities are held to so much less than the states */
#define NODES 4                             /* kept for output between steps */
#define UNEVEN 50.0                         /* a neighbour so much shorter or longer would spoil the interpolation */

/* last row of A^-1: the slope of the collocation polynomial at the step's end from the stage increments */
static const double D[3] = {5.531972647421808261859, -7.531972647421808261859, 5.0};

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

#ifdef NT
#define TN NT
#else
#define TN 1
#endif

/* the tables at one state: the first of the four numbers that count, their bumps, and what value and slope do to the rates */
typedef struct {
    int cell[TN];
    double value[4 * TN], slope[4 * TN], G[NX * 2 * TN];
} Felt;

static void feel(Felt *felt, const double *x, double V, double W, double W_dot, const double *p) {
#ifdef NT
    double arguments[NT], share, unused[4];
    memset(arguments, 0, sizeof arguments);
    memset(felt->G, 0, sizeof felt->G);
    srf_table_arguments(x, V, W, W_dot, p, arguments);
    srf_rates_tables(x, V, W, W_dot, p, felt->G);
    for (int i = 0; i < NT; i++) {
        const double *head = p + NP + 4 * i;
        felt->cell[i] = -1;
        if (head[3] < 4.0) continue;
        felt->cell[i] = srf_cell(p, i, arguments[i], &share);
        srf_weights(share, felt->value + 4 * i, felt->slope + 4 * i, unused);
        int outside = arguments[i] < head[1] || arguments[i] > head[1] + head[2] * (head[3] - 3.0);
        for (int k = 0; k < 4; k++) felt->slope[4 * i + k] = outside ? 0.0 : felt->slope[4 * i + k] / head[2];
    }
#else
    (void)felt; (void)x; (void)V; (void)W; (void)W_dot; (void)p;
#endif
}

static double bump(const Felt *felt, int r, int i, int k) {
    return felt->G[r * 2 * TN + 2 * i] * felt->value[4 * i + k] + felt->G[r * 2 * TN + 2 * i + 1] * felt->slope[4 * i + k];
}

typedef struct {
    int ns, own;                            /* all columns; those of parameters and starts come first, tables after them */
    const int *which;
    int column[TN];                         /* where a table's columns begin, -1 for none */
    const double *scale;                    /* of each column: a unit of change of what it is the derivative by */
    double *S, *Sf, *work;                  /* NX x ns at each node, one after another */
    int *active, stride;                    /* columns that the last step solved for, and how wide `work` is */
    double *Sf_now;                         /* NX x ns, evaluated at the last node; Sf holds slopes for output */
    double *explicit_work;                  /* 18 times NX x ns, for dop853.c; NULL where tables have columns */
    int nodes;
    Node node[NODES];
} History;

static void sensitivity_rates(History *q, int slot, Imposed *force) {
    if (!q->ns) return;
    Felt felt;
    double V, W, W_dot, J[NX * NX], P[NX * NP];
    const Node *n = &q->node[slot];
    double *S = q->S + (size_t)slot * NX * q->ns, *F = q->Sf_now;
    imposed(force, n->t, &V, &W, &W_dot);
    memset(J, 0, sizeof J);
    memset(P, 0, sizeof P);
    srf_jacobian(n->x, V, W, W_dot, force->p, J);
    srf_parameters(n->x, V, W, W_dot, force->p, P);
    feel(&felt, n->x, V, W, W_dot, force->p);
    for (int r = 0; r < NX; r++) {
        double *out = F + (size_t)r * q->ns;
        memset(out, 0, q->ns * sizeof(double));
        for (int c = 0; c < NX; c++) {
            double j = J[r * NX + c];
            const double *from = S + (size_t)c * q->ns;
            for (int k = 0; k < q->ns; k++) out[k] += j * from[k];
        }
        for (int k = 0; k < q->own; k++)
            if (q->which[k] >= 0) out[k] += P[r * NP + q->which[k]];
        for (int i = 0; i < TN; i++)
            for (int k = 0; q->column[i] >= 0 && felt.cell[i] >= 0 && k < 4; k++) out[q->column[i] + felt.cell[i] + k] += bump(&felt, r, i, k);
    }
}

/* slopes of S at the step's end, from the increments that step_sensitivities left in q->work */
static void output_slopes(History *q, double h) {
    int ns = q->ns, m = q->stride, carried = ns > q->own, na = m - (carried ? NX : 0);
    size_t rows = (size_t)NX * m;
    const double *S = q->S + (size_t)(q->nodes - 1) * NX * ns;
    double *F = q->Sf + (size_t)q->nodes * NX * ns, slope[NX];
    for (int r = 0; r < NX; r++) {
        const double *B = q->work + (size_t)r * m;
        double *out = F + (size_t)r * ns;
        if (carried) {
            memset(out, 0, ns * sizeof(double));
            for (int c = 0; c < NX; c++) {
                slope[c] = (D[0] * B[na + c] + D[1] * B[rows + na + c] + D[2] * B[2 * rows + na + c]) / h;
                for (int k = q->own; k < ns; k++) out[k] += slope[c] * S[(size_t)c * ns + k];
            }
        }
        for (int k = 0; k < na; k++) out[q->active[k]] = (D[0] * B[k] + D[1] * B[rows + k] + D[2] * B[2 * rows + k]) / h;
    }
}

/* The slopes for output at the first step's start from its increments, as in output_slopes. What hands over ends a hair off the slow
   motion of a stiff state: the rates there are those of a return to it that takes no time. */
static void restart_slopes(History *q, const double *Z, double h) {
    const double node[4] = {0.0, C[0], C[1], 1.0};
    double G[3];
    for (int k = 1; k < 4; k++) {
        double l = 1.0 / node[k];
        for (int j = 1; j < 4; j++)
            if (j != k) l *= -node[j] / (node[k] - node[j]);
        G[k - 1] = l / h;
    }
    for (int r = 0; r < NX; r++) q->node[0].f[r] = G[0] * Z[r] + G[1] * Z[NX + r] + G[2] * Z[2 * NX + r];
    size_t rows = (size_t)NX * q->stride;
    for (int r = 0; r < NX * q->ns; r++) q->Sf[r] = G[0] * q->work[r] + G[1] * q->work[rows + r] + G[2] * q->work[2 * rows + r];
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
static NOINLINE int write_outputs(History *q, int i, int next, int nt, const double *t, double *X, double *S) {
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

/* how far the output's polynomial passes by the inner stages. The estimate's filter forgives a stiff component everything
   between the nodes: at rest ln v follows the load as if there were no inertia, and turns within what u would take in one step. */
static double between(const Node *from, double h, const double *Z, double rtol, const double *atol) {
    double worst = 0.0, gap[NX];
    for (int i = 0; i < 2; i++) {
        double s = C[i];
        for (int r = 0; r < NX; r++) {
            double end = Z[2 * NX + r], slope = D[0] * Z[r] + D[1] * Z[NX + r] + D[2] * end;
            gap[r] = Z[i * NX + r] - s * (1 - s) * (1 - s) * h * from->f[r] - s * s * (3 - 2 * s) * end - s * s * (s - 1) * slope;
        }
        worst = fmax(worst, norm(gap, from->x, rtol, atol));
    }
    return worst;
}

/* S after the step: the linear equations of the stages with their converged Jacobians. A column that nothing feeds during the
   step, as that of a table's number which is not felt there, is only carried on. */
static NOINLINE int step_sensitivities(History *q, Imposed *force, const Node *from, double h, const double *Z) {
    int ns = q->ns, na = q->own, carried = ns > q->own;
    StageMatrix matrix;
    double J[3][NX * NX], P[3][NX * NP], x[NX], V, W, W_dot, *B = q->work;
    Felt felt[3];
    const double *S = q->S + (size_t)(q->nodes - 1) * NX * ns;
    for (int i = 0; i < 3; i++) {
        imposed(force, from->t + C[i] * h, &V, &W, &W_dot);
        for (int r = 0; r < NX; r++) x[r] = from->x[r] + Z[i * NX + r];
        memset(J[i], 0, sizeof J[i]);
        memset(P[i], 0, sizeof P[i]);
        srf_jacobian(x, V, W, W_dot, force->p, J[i]);
        srf_parameters(x, V, W, W_dot, force->p, P[i]);
        if (carried) feel(&felt[i], x, V, W, W_dot, force->p);
    }
    int *active = q->active;
    for (int k = 0; k < na; k++) active[k] = k;
    for (int t = 0; carried && t < TN; t++)
        for (int i = 0; q->column[t] >= 0 && i < 3; i++)
            for (int k = 0; felt[i].cell[t] >= 0 && k < 4; k++) {
                int column = q->column[t] + felt[i].cell[t] + k, known = 0;
                for (int j = q->own; j < na; j++) known |= active[j] == column;
                if (!known) active[na++] = column;
            }
    int m = na + (carried ? NX : 0);
    double *G = B + (size_t)NZ * m;
    q->stride = m;
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < NX; r++) {
            double *out = G + ((size_t)i * NX + r) * m;
            for (int k = 0; k < na; k++) {
                double sum = k < q->own && q->which[k] >= 0 ? P[i][r * NP + q->which[k]] : 0.0;
                for (int c = 0; c < NX; c++) sum += J[i][r * NX + c] * S[(size_t)c * ns + active[k]];
                out[k] = sum;
            }
            for (int k = na; k < m; k++) out[k] = J[i][r * NX + k - na];
            for (int t = 0; carried && t < TN; t++)
                for (int k = 0; q->column[t] >= 0 && felt[i].cell[t] >= 0 && k < 4; k++)
                    for (int j = q->own; j < na; j++)
                        if (active[j] == q->column[t] + felt[i].cell[t] + k) out[j] += bump(&felt[i], r, t, k);
        }
    size_t rows = (size_t)NX * m;
    for (int i = 0; i < 3; i++)
        for (size_t r = 0; r < rows; r++)
            B[(size_t)i * rows + r] = h * (A[i][0] * G[r] + A[i][1] * G[rows + r] + A[i][2] * G[2 * rows + r]);
    if (!stage_matrix(&matrix, (const double(*)[NX * NX])J, h)) return 0;
    solve_stages(&matrix, B, m);
    double *after = q->S + (size_t)q->nodes * NX * ns;
    for (int r = 0; r < NX; r++) {
        double *out = after + (size_t)r * ns;
        const double *gained = B + 2 * rows + (size_t)r * m;
        if (carried) {
            memcpy(out, S + (size_t)r * ns, ns * sizeof(double));
            for (int c = 0; c < NX; c++) {
                const double *before = S + (size_t)c * ns, through = gained[na + c];
                for (int k = q->own; k < ns; k++) out[k] += through * before[k];
            }
        }
        for (int k = 0; k < na; k++) out[active[k]] = S[(size_t)r * ns + active[k]] + gained[k];
    }
    return finite_all(after, NX * ns);
}

/* the same estimate for parameters and starts, from the increments that step_sensitivities left in q->work; its largest norm */
static double estimate_sensitivities(const History *q, double h, const double *J0, double rtol, const double *atol) {
    int ns = q->ns, own = q->own, pivot[NX];
    size_t size = (size_t)NX * ns, rows = (size_t)NX * q->stride;
    double matrix[NX * NX], worst = 0.0, *B = q->work, *e = B + 3 * rows;
    const double *S = q->S + (q->nodes - 1) * size, *F = q->Sf_now;
    if (!own) return 0.0;
    if (!estimate_matrix(J0, h, matrix, pivot)) return INFINITY;
    for (int r = 0; r < NX; r++)
        for (int k = 0; k < own; k++) {
            const double *b = B + (size_t)r * q->stride + k;
            e[r * own + k] = (E[0] * b[0] + E[1] * b[rows] + E[2] * b[2 * rows]) / h + F[(size_t)r * ns + k];
        }
    filter_estimate(matrix, pivot, e, own);
    for (int k = 0; k < own; k++) {
        double sum = 0.0;
        for (int r = 0; r < NX; r++) {
            double x = S[(size_t)r * ns + k], one = e[r * own + k] / (SHARE * (atol[r] * q->scale[k] + rtol * fabs(x)));
            sum += one * one;
        }
        worst = fmax(worst, sum);
    }
    return isfinite(worst) ? sqrt(worst / NX) : INFINITY;
}

/* how long a step Radau IIA would make from a node, tried with h; 0 where Newton's method fails */
static double implicit_reach(Imposed *force, const Node *from, double h, double rtol, const double *atol) {
    StageMatrix matrix;
    double Z[NZ], Z0[NZ], J0[NX * NX];
    memset(Z0, 0, sizeof Z0);
    matrix.h = 0.0;
    if (!(h > 0.0) || !stages(force, from, h, Z0, rtol, atol, Z, &matrix)) return 0.0;
    jacobian_at(force, from->t, from->x, J0);
    double error = fmax(estimate(force, from, from->f, h, Z, J0, rtol, atol, 1), between(from, h, Z, rtol, atol));
    return h * fmin(8.0, 0.9 * pow(error, -0.25));
}

static int explicit_steps(Imposed *force, History *q, double b, double rtol, const double *atol, double longest, long max_steps, int next, int nt, const double *t, double *X, double *S, double *stats, const volatile int *stop);

/* integrates one smooth segment [a, b], explicitly as far as it is not stiff; returns the next output index, or -1 - (it) where it stopped early */
static NOINLINE int segment(Imposed *force, History *q, double a, double b, double rtol, const double *atol, double longest, long max_steps, int next, int nt, const double *t, double *X, double *S, double *stats, const volatile int *stop) {
    StageMatrix matrix;
    Control control = {{0.0}, 0.0, 0.0, 0.0, 0};
    double Z[NZ], J0[NX * NX], f0[NX], carry = 0.0;
    int unseen = 0, handed = 0;
    Node *now = &q->node[0];
    now->t = a;
    rates_at(force, a, now->x, now->f);
    q->nodes = 1;
    if (!q->ns || q->explicit_work) {
        next = explicit_steps(force, q, b, rtol, atol, longest, max_steps, next, nt, t, X, S, stats, stop);
        if (next < 0 || now->t >= b) return next;
        handed = now->t > a;
        rates_at(force, now->t, now->x, now->f);
    }
    memcpy(f0, now->f, sizeof f0);
    sensitivity_rates(q, 0, force);
    if (q->ns) memcpy(q->Sf, q->Sf_now, (size_t)NX * q->ns * sizeof(double));
    double h = fmin(first_step(force, now, b - now->t, rtol, atol), longest);
    while (now->t < b) {
        if (*stop || stats[0] + stats[1] >= max_steps) return -1 - next;
        int final = fitted(&h, b - now->t);
        /* A slider that stops passes through many decades of v in less time than t can tell apart: t is summed with its carry,
           and the steps may be as small as they like, though not for ever. */
        if (h < 4.0 * DBL_EPSILON * fmax(fabs(now->t), fabs(b)) && !final && ++unseen > MAX_UNSEEN) return -1 - next;
        int newton = attempt(force, now, h, &control, 1, rtol, atol, Z, &matrix), first = control.last_h == 0.0;
        double error = INFINITY;
        if (newton) {
            jacobian_at(force, now->t, now->x, J0);
            error = estimate(force, now, f0, h, Z, J0, rtol, atol, first || control.rejected);
            if (!first) error = fmax(error, between(now, h, Z, rtol, atol));
            if (error < 1.0 && q->ns) {
                double other = step_sensitivities(q, force, now, h, Z) ? estimate_sensitivities(q, h, J0, rtol, atol) : INFINITY;
                error = fmax(error, other);
            }
        }
        if (!(error < 1.0)) {
            stats[1] += 1;
            h = next_length(&control, h, error, newton);
            if (h < 1e-300) return -1 - next;
            continue;
        }
        Node after;
        after.t = time_after(now->t, h, b, final, &carry);
        for (int r = 0; r < NX; r++) after.x[r] = now->x[r] + Z[2 * NX + r];
        double f_after[NX];
        rates_at(force, after.t, after.x, f_after);
        /* The rates at the step's end are J times what Newton's method left: at 1e-6 um/s J is 1e10 / s and they are noise.
           The same slope from the increments carries that remainder over h. */
        for (int r = 0; r < NX; r++) after.f[r] = (D[0] * Z[r] + D[1] * Z[NX + r] + D[2] * Z[2 * NX + r]) / h;
        if (!finite_all(after.x, NX) || !finite_all(f_after, NX)) {
            h *= 0.25;
            control.rejected = 1;
            stats[1] += 1;
            control.before = 0.0;
            continue;
        }
        memcpy(f0, f_after, sizeof f0);
        q->node[q->nodes] = after;
        output_slopes(q, h);
        if (handed) restart_slopes(q, Z, h);
        handed = 0;
        q->nodes++;
        sensitivity_rates(q, q->nodes - 1, force);
        stats[0] += 1;
        if (q->nodes > 2) next = write_outputs(q, q->nodes - 3, next, nt, t, X, S);
        if (final) next = write_outputs(q, q->nodes - 2, next, nt, t, X, S);
        if (q->nodes == NODES && !final) drop_oldest(q);
        now = &q->node[q->nodes - 1];
        memcpy(control.Z, Z, sizeof Z);
        control.before = h;
        h = fmin(next_length(&control, h, error, newton), longest);
    }
    return next;
}

/* Returns how many output times were filled; stats: steps, rejected, time reached.
   X (nt, NX), S (nt, NX, ns); column k < own of S belongs to parameter which[k], or to an initial condition where which[k] < 0;
   the numbers of table i, all of them, own the columns from column[i] on, if that is not negative.
   The output at t[0], the start, is the caller's. Another thread may set *stop: the motion then ends with the step in hand. */
int srf_integrate(int n_segments, const double *edges, const double *drive, const int *range, const double *longest, int n_knots, int degree, const double *knots, const double *coefficients, const double *p, const double *x0, int ns, int own, const int *column, const int *which, const double *scale, const double *S0, double rtol, const double *atol, long max_steps, int nt, const double *t, double *X, double *S, double *stats, const volatile int *stop) {
    Imposed force = {n_knots, degree, knots, coefficients, 0, 0, 0, 0.0, 0.0, 0.0, p};
    History q;
    size_t size = (size_t)NX * ns;
    int next = 0;
    double *block = NULL;
    memset(&q, 0, sizeof q);
    q.ns = ns;
    q.own = own;
    for (int i = 0; i < TN; i++) q.column[i] = column[i];
    q.which = which;
    q.scale = scale;
    if (ns) {
        size_t widest = own + 12 * TN + NX;
        block = malloc(((2 * NODES + 19) * size + 2 * NZ * widest) * sizeof(double) + widest * sizeof(int));
        if (!block) return -1;
        q.S = block;
        q.Sf = block + NODES * size;
        q.work = block + 2 * NODES * size;
        q.Sf_now = q.work + 2 * NZ * widest;
        q.explicit_work = ns > own ? NULL : q.Sf_now + size;
        q.active = (int *)(q.Sf_now + 19 * size);
        memcpy(q.S, S0, size * sizeof(double));
    }
    memcpy(q.node[0].x, x0, NX * sizeof(double));
    while (next < nt && t[next] <= edges[0]) { /* the start itself */
        memcpy(X + (size_t)next * NX, x0, NX * sizeof(double));
        if (ns) memcpy(S + (size_t)next * size, S0, size * sizeof(double));
        next++;
    }
    stats[0] = stats[1] = 0.0;
    stats[2] = edges[0];
    for (int k = 0; k < n_segments; k++) {
        force.low = force.at = range[2 * k];
        force.high = range[2 * k + 1] - 1;
        force.V = drive[3 * k];
        force.acceleration = drive[3 * k + 1];
        force.since = drive[3 * k + 2];
        int done = segment(&force, &q, edges[k], edges[k + 1], rtol, atol, longest[k], max_steps, next, nt, t, X, S, stats, stop);
        if (done < 0) {
            stats[2] = q.node[q.nodes - 1].t;
            free(block);
            return -1 - done;
        }
        next = done;
        stats[2] = edges[k + 1];
        q.node[0] = q.node[q.nodes - 1];
        if (ns) memmove(q.S, q.S + (size_t)(q.nodes - 1) * size, size * sizeof(double));
    }
    free(block);
    return next;
}
