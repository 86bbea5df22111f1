/* Newton's equations of periodic orbits: Gauss collocation over one forcing period, condensed interval by interval.

   The same equations, in the same order, as numerics/collocation.py and numerics/boundary.py, which hold where there is no
   compiler. Compiled behind lu.c, for all models of NX states, with MS Gauss points and LOG_STEP; linked with a model, whose text
   has what is declared here.
   MI is the inverse of the collocation matrix, STEP the weights of x_1 = x_0 + STEP . (X - x_0).
   Arrays are row-major, batches of parameter points first; p is (points, NP). */

MODEL void srf_cycle(double tau, const double *x, const double *p, double *out);          /* (NX) */
MODEL void srf_cycle_jacobian(double tau, const double *x, const double *p, double *out); /* (NX, NX) */
MODEL void srf_cycle_parameter(int which, double tau, const double *x, const double *p, double *out);
MODEL void srf_bilinear(double tau, const double *x, const double *p, const double *w, const double *a, double *out); /* (NX) */
MODEL double srf_bilinear_parameter(int which, double tau, const double *x, const double *p, const double *w, const double *a);
MODEL extern const int NP, LOGS[];          /* parameters; which states are logarithms */

#define S (MS * NX)
#define PAD (8 * ((NX + 3 + 7) / 8)) /* columns of the right side, room for two parameters among them */
#define T (S + PAD)

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif

/* b := a^-T b for two columns */
static void solve_transposed(int n, const double *a, const int *pivot, double *b) {
    for (int i = 0; i < n; i++) {
        double inverse = 1.0 / a[i * n + i], re = b[2 * i] * inverse, im = b[2 * i + 1] * inverse;
        b[2 * i] = re;
        b[2 * i + 1] = im;
        for (int k = i + 1; k < n; k++) {
            b[2 * k] -= a[i * n + k] * re;
            b[2 * k + 1] -= a[i * n + k] * im;
        }
    }
    for (int i = n - 1; i > 0; i--)
        for (int k = 0; k < i; k++) {
            b[2 * k] -= a[i * n + k] * b[2 * i];
            b[2 * k + 1] -= a[i * n + k] * b[2 * i + 1];
        }
    for (int k = n - 1; k >= 0; k--)
        if (pivot[k] != k)
            for (int c = 0; c < 2; c++) {
                double t = b[2 * k + c];
                b[2 * k + c] = b[2 * pivot[k] + c];
                b[2 * pivot[k] + c] = t;
            }
}

/* Row elimination of [a | b] in rows of the fixed length T, which compilers turn into vectors; a ends as its LU factors, b as a^-1 b */
static int eliminate(double m[S][T], int *pivot) {
    for (int k = 0; k < S; k++) {
        double largest = 0.0, row[T];
        for (int i = k; i < S; i++) largest = fabs(m[i][k]) > largest ? fabs(m[i][k]) : largest;
        if (!(largest > 0.0) || !isfinite(largest)) return 0;
        pivot[k] = k;
        if (fabs(m[k][k]) < THRESHOLD * largest) { /* seldom: the search costs more than the rest of the step */
            while (fabs(m[pivot[k]][k]) < largest) pivot[k]++;
            for (int j = 0; j < T; j++) {
                double t = m[k][j];
                m[k][j] = m[pivot[k]][j];
                m[pivot[k]][j] = t;
            }
        }
        double inverse = 1.0 / m[k][k];
        for (int j = 0; j < T; j++) row[j] = j > k ? m[k][j] : 0.0; /* factors to the left stay */
        for (int i = k + 1; i < S; i++) {
            double f = m[i][k] * inverse;
            for (int j = 0; j < T; j++) m[i][j] -= f * row[j];
            m[i][k] = f;
        }
    }
    for (int i = S - 1; i >= 0; i--) {
        double sum[PAD], inverse = 1.0 / m[i][i];
        for (int j = 0; j < PAD; j++) sum[j] = m[i][S + j];
        for (int k = i + 1; k < S; k++) {
            double f = m[i][k];
            for (int j = 0; j < PAD; j++) sum[j] -= f * m[k][S + j];
        }
        for (int j = 0; j < PAD; j++) m[i][S + j] = sum[j] * inverse;
    }
    return 1;
}

/* One interval: its stage matrix factored, the stages' response `local` (S, w) and the map (NX, w) of its first state, w = NX + 1 + k.
   Columns: NX for the first state, one for the residual, k for the parameters, of which those beyond PAD are solved for apart.
   `lu` and `pivot` get the factors where lu is not 0. */
static int interval(double h, const double *tau, const double *p, const double *x, const double *X, const double *next, int k,
                    const int *which, double *lu, int *pivot, double *local, double *map) {
    const int w = NX + 1 + k, near = w < PAD ? w : PAD;
    double m[S][T], f[NX], J[NX * NX], inverse = 1.0 / h;
    memset(m, 0, sizeof m);
    for (int j = 0; j < MS; j++) {
        double rows = 0.0;
        for (int i = 0; i < MS; i++) {
            double c = MI[j][i] * inverse;
            rows += c;
            for (int a = 0; a < NX; a++) m[j * NX + a][i * NX + a] = c;
        }
        memset(f, 0, sizeof f);
        memset(J, 0, sizeof J);
        srf_cycle(tau[j], X + j * NX, p, f);
        srf_cycle_jacobian(tau[j], X + j * NX, p, J);
        for (int a = 0; a < NX; a++) {
            double slope = 0.0, *row = m[j * NX + a];
            for (int b = 0; b < NX; b++) row[j * NX + b] -= J[a * NX + b];
            for (int i = 0; i < MS; i++) slope += MI[j][i] * (X[i * NX + a] - x[a]);
            row[S + a] = rows;
            row[S + NX] = f[a] - slope * inverse;
        }
        for (int c = 0; c < k; c++) {
            memset(f, 0, sizeof f);
            srf_cycle_parameter(which[c], tau[j], X + j * NX, p, f);
            for (int a = 0; a < NX; a++) {
                if (NX + 1 + c < PAD) m[j * NX + a][S + NX + 1 + c] = f[a];
                else local[(j * NX + a) * w + NX + 1 + c] = f[a];
            }
        }
    }
    if (!eliminate(m, pivot)) return 0;
    for (int s = 0; s < S; s++)
        for (int c = 0; c < near; c++) local[s * w + c] = m[s][S + c];
    if (lu)
        for (int s = 0; s < S; s++) memcpy(lu + s * S, m[s], sizeof(double) * S);
    for (int c = PAD; c < w; c++) {
        double column[S];
        for (int s = 0; s < S; s++) column[s] = local[s * w + c];
        solve(S, lu, pivot, NULL, column, 1);
        for (int s = 0; s < S; s++) local[s * w + c] = column[s];
    }
    double rest = 1.0;
    for (int j = 0; j < MS; j++) rest -= STEP[j];
    for (int a = 0; a < NX; a++) {
        for (int c = 0; c < w; c++) {
            double sum = 0.0;
            for (int j = 0; j < MS; j++) sum += STEP[j] * local[(j * NX + a) * w + c];
            map[a * w + c] = sum;
        }
        map[a * w + a] += rest;
        double gap = x[a] - next[a];
        for (int j = 0; j < MS; j++) gap += STEP[j] * (X[j * NX + a] - x[a]);
        map[a * w + NX] += gap;
    }
    return 1;
}

/* out = map after before, of affine maps (NX, w) whose last w - NX rows are those of the identity */
static void chained(int w, const double *map, const double *before, double *out) {
    for (int a = 0; a < NX; a++)
        for (int c = 0; c < w; c++) {
            double sum = c < NX ? 0.0 : map[a * w + c];
            for (int b = 0; b < NX; b++) sum += map[a * w + b] * before[b * w + c];
            out[a * w + c] = sum;
        }
}

/* Newton's method for the periodic orbits of B points, each until its step is below tol; x (B, N, NX) and X (B, N, MS, NX) are the
   guesses, then the last iterates. `size` (B, NX) measures x. Returns 0 without memory. */
EXPORT int srf_orbits(int B, int N, const double *tau, const double *h, const double *p, double *x, double *X, const double *size,
                      double tol, int max_iterations, double *monodromy, unsigned char *converged) {
    enum { w = NX + 1 };
    double *local = malloc(sizeof(double) * N * (S * w + NX * w + NX + S)), map[NX * w];
    if (!local) return 0;
    double *prefix = local + (size_t)N * S * w, *dx = prefix + (size_t)N * NX * w, *dX = dx + (size_t)N * NX;
    int pivot[S];
    for (int b = 0; b < B; b++) {
        const double *own = p + (size_t)b * NP, *scale = size + (size_t)b * NX;
        double *y = x + (size_t)b * N * NX, *Y = X + (size_t)b * N * S, *M = monodromy + (size_t)b * NX * NX;
        converged[b] = 0;
        for (int iteration = 1; iteration <= max_iterations; iteration++) {
            double now[NX * w], then[NX * w];
            memset(now, 0, sizeof now);
            for (int a = 0; a < NX; a++) now[a * w + a] = 1.0;
            int good = 1;
            for (int i = 0; i < N && good; i++) {
                memcpy(prefix + (size_t)i * NX * w, now, sizeof now);
                good = interval(h[i], tau + i * MS, own, y + i * NX, Y + i * S, y + (i + 1 < N ? i + 1 : 0) * NX, 0, 0, 0, pivot,
                                local + (size_t)i * S * w, map);
                chained(w, map, now, then);
                memcpy(now, then, sizeof now);
            }
            if (!good) break;
            double matrix[NX * NX], start[NX];
            for (int a = 0; a < NX; a++) {
                for (int c = 0; c < NX; c++) {
                    M[a * NX + c] = now[a * w + c];
                    matrix[a * NX + c] = (a == c) - now[a * w + c];
                }
                start[a] = now[a * w + NX];
            }
            if (!factor(NX, 1.0, matrix, pivot)) break;
            solve(NX, matrix, pivot, NULL, start, 1);
            double change = 0.0, swing = 0.0;
            int finite = 1;
            for (int i = 0; i < N; i++) {
                const double *P = prefix + (size_t)i * NX * w, *L = local + (size_t)i * S * w;
                for (int a = 0; a < NX; a++) {
                    double sum = P[a * w + NX];
                    for (int c = 0; c < NX; c++) sum += P[a * w + c] * start[c];
                    dx[i * NX + a] = sum;
                    finite &= isfinite(sum) != 0;
                    change = fmax(change, fabs(sum) / scale[a]);
                    if (LOGS[a]) swing = fmax(swing, fabs(sum));
                }
                for (int s = 0; s < S; s++) {
                    double sum = L[s * w + NX];
                    for (int c = 0; c < NX; c++) sum += L[s * w + c] * dx[i * NX + c];
                    dX[i * S + s] = sum;
                    finite &= isfinite(sum) != 0;
                    if (LOGS[s % NX]) swing = fmax(swing, fabs(sum));
                }
            }
            if (!finite) break;
            double limit = swing > LOG_STEP ? LOG_STEP / swing : 1.0;
            for (int i = 0; i < N * NX; i++) y[i] += limit * dx[i];
            for (int i = 0; i < N * S; i++) Y[i] += limit * dX[i];
            if (change < tol) {
                converged[b] = 1;
                break;
            }
        }
    }
    free(local);
    return 1;
}

/* (M - sigma)^-1 in real form, [M - re, im; -im, M - re], factored; M transposed where asked for */
static int shifted(const double *M, int transposed, const double *sigma, double *a, int *pivot) {
    const int m = 2 * NX;
    memset(a, 0, sizeof(double) * m * m);
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) a[i * m + j] = a[(NX + i) * m + NX + j] = transposed ? M[j * NX + i] : M[i * NX + j];
        a[i * m + i] -= sigma[0];
        a[(NX + i) * m + NX + i] -= sigma[0];
        a[i * m + NX + i] = sigma[1];
        a[(NX + i) * m + i] = -sigma[1];
    }
    return factor(m, 1.0, a, pivot);
}

/* One step of inverse iteration: v becomes the unit vector along (M - sigma)^-1 v, rho what the step says of the eigenvalue */
static void iterated(const double *a, const int *pivot, const double *sigma, double *v, double *rho) {
    double before[2 * NX], square = 0.0, re = 0.0, im = 0.0;
    memcpy(before, v, sizeof before);
    solve(2 * NX, a, pivot, NULL, v, 1);
    for (int i = 0; i < NX; i++) {
        square += v[i] * v[i] + v[NX + i] * v[NX + i];
        re += v[i] * before[i] + v[NX + i] * before[NX + i];
        im += v[i] * before[NX + i] - v[NX + i] * before[i];
    }
    rho[0] = sigma[0] + re / square; /* v^H before / v^H v is 1 / (that of the inverse) */
    rho[1] = sigma[1] + im / square;
    for (int i = 0; i < 2 * NX; i++) v[i] /= sqrt(square);
}

/* The eigenvalue rho of M next to `target`, above the real axis, with its right and left vectors (NX, 2) as pairs, l . r = 1:
   inverse iteration with the target as shift, then with what it found. */
static int eigenpair(const double *M, const double *target, double *rho, double *r, double *l) {
    double a[4 * NX * NX], v[2][2 * NX], sigma[2] = {target[0], target[1]}, last[2];
    int pivot[2 * NX];
    for (int i = 0; i < NX; i++) {
        v[0][i] = 1.0 / (1 + i);
        v[0][NX + i] = 0.3 / (2 + i);
    }
    for (int round = 0; round < 6; round++) {
        double nudge = 1e-15;
        while (!shifted(M, 0, sigma, a, pivot)) { /* an exact eigenvalue, or a matrix without finite factors */
            if (!isfinite(sigma[0] + sigma[1]) || nudge > 1e-12) return 0;
            sigma[0] += nudge + nudge * fabs(sigma[0]);
            nudge *= 10.0;
        }
        memcpy(rho, sigma, sizeof last);
        for (int step = 0; step < (round ? 2 : 40); step++) {
            memcpy(last, rho, sizeof last);
            iterated(a, pivot, sigma, v[0], rho);
            if (hypot(rho[0] - last[0], rho[1] - last[1]) < 1e-3 * hypot(rho[0] - sigma[0], rho[1] - sigma[1])) break;
        }
        if (!isfinite(rho[0] + rho[1])) return 0;
        int settled = hypot(rho[0] - sigma[0], rho[1] - sigma[1]) < 1e-13 * hypot(rho[0], rho[1]);
        memcpy(sigma, rho, sizeof last);
        if (settled && round) break;
    }
    if (rho[1] < 0.0) { /* of a pair met from a real target */
        rho[1] = -rho[1];
        for (int i = 0; i < NX; i++) v[0][NX + i] = -v[0][NX + i];
    }
    if (rho[1] < 1e-13 * fabs(rho[0])) rho[1] = 0.0;
    sigma[0] = rho[0] * (1 + 1e-14);
    sigma[1] = rho[1] * (1 + 1e-14);
    for (int i = 0; i < 2 * NX; i++) v[1][i] = i < NX ? v[0][i] : -v[0][i];
    for (int side = 0; side < 2; side++) {
        double found[2];
        if (!shifted(M, side, sigma, a, pivot)) return 0;
        for (int step = 0; step < 3; step++) iterated(a, pivot, sigma, v[side], found);
    }
    double re = 0.0, im = 0.0;
    for (int i = 0; i < NX; i++) {
        re += v[1][i] * v[0][i] - v[1][NX + i] * v[0][NX + i];
        im += v[1][i] * v[0][NX + i] + v[1][NX + i] * v[0][i];
    }
    double square = re * re + im * im;
    for (int i = 0; i < NX; i++) {
        r[2 * i] = v[0][i];
        r[2 * i + 1] = v[0][NX + i];
        l[2 * i] = (v[1][i] * re + v[1][NX + i] * im) / square;
        l[2 * i + 1] = (v[1][NX + i] * re - v[1][i] * im) / square;
    }
    return isfinite(square) && square > 0.0;
}

/* One orbit's linearisation with k parameter columns, w = NX + 1 + k: factored stage matrices, the stages' responses, the intervals'
   maps (w, w) and their products from tau = 0 on */
typedef struct {
    double *lu, *local, *maps, *prefix;
    int *pivot;
} linearised;

/* The derivative row `out` (w) of ln |rho| by (dx_0, residual, parameters), from a linearisation and the right and left eigenvectors r
   and l (NX, 2) of the monodromy matrix for rho, l . r = 1; complex numbers as pairs. */
static void growth_row(int N, int k, const int *which, const double *tau, const double *own, const double *X, const linearised *at,
                       const double *rho, const double *r, const double *l, double *out) {
    const int w = NX + 1 + k;
    double back[2 * NX], square = rho[0] * rho[0] + rho[1] * rho[1];
    double scale_re = rho[0] / square, scale_im = -rho[1] / square;
    memset(out, 0, sizeof(double) * w);
    for (int a = 0; a < NX; a++) { /* 1/rho goes with l */
        double re = l[2 * a], im = l[2 * a + 1];
        back[2 * a] = re * scale_re - im * scale_im;
        back[2 * a + 1] = re * scale_im + im * scale_re;
    }
    for (int i = N - 1; i >= 0; i--) {
        const double *here = at->prefix + (size_t)i * w * w, *L = at->local + (size_t)i * S * w, *map = at->maps + (size_t)i * w * w;
        double v0[2 * NX], v[2][S], seed[2 * S], own_row[NX + 1 + k];
        for (int a = 0; a < NX; a++)
            for (int c = 0; c < 2; c++) {
                double sum = 0.0;
                for (int d = 0; d < NX; d++) sum += here[a * w + d] * r[2 * d + c];
                v0[2 * a + c] = sum;
            }
        for (int s = 0; s < S; s++)
            for (int c = 0; c < 2; c++) {
                double sum = 0.0;
                for (int d = 0; d < NX; d++) sum += L[s * w + d] * v0[2 * d + c];
                v[c][s] = sum;
                seed[2 * s + c] = STEP[s / NX] * back[2 * (s % NX) + c];
            }
        solve_transposed(S, at->lu + (size_t)i * S * S, at->pivot + i * S, seed);
        memset(own_row, 0, sizeof(double) * w);
        for (int j = 0; j < MS; j++) {
            double w_re[NX], w_im[NX], g[NX], g_im[NX];
            for (int a = 0; a < NX; a++) {
                w_re[a] = seed[2 * (j * NX + a)];
                w_im[a] = seed[2 * (j * NX + a) + 1];
            }
            const double *Y = X + (i * MS + j) * NX;
            memset(g, 0, sizeof g);
            memset(g_im, 0, sizeof g_im);
            srf_bilinear(tau[i * MS + j], Y, own, w_re, v[0] + j * NX, g);
            srf_bilinear(tau[i * MS + j], Y, own, w_im, v[1] + j * NX, g_im);
            for (int a = 0; a < NX; a++) {
                double weight = g[a] - g_im[a];
                for (int c = 0; c < w; c++) own_row[c] += weight * L[(j * NX + a) * w + c];
            }
            for (int c = 0; c < k; c++)
                out[NX + 1 + c] += srf_bilinear_parameter(which[c], tau[i * MS + j], Y, own, w_re, v[0] + j * NX) -
                                   srf_bilinear_parameter(which[c], tau[i * MS + j], Y, own, w_im, v[1] + j * NX);
        }
        for (int c = 0; c < w; c++) {
            double sum = c < NX ? 0.0 : own_row[c];
            for (int d = 0; d < NX; d++) sum += own_row[d] * here[d * w + c];
            out[c] += sum;
        }
        double before[2 * NX];
        for (int a = 0; a < NX; a++)
            for (int c = 0; c < 2; c++) {
                double sum = 0.0;
                for (int d = 0; d < NX; d++) sum += map[d * w + a] * back[2 * d + c];
                before[2 * a + c] = sum;
            }
        memcpy(back, before, sizeof back);
    }
}

/* Newton's equations of B points {periodic, ln |rho| = 0}, rho the multiplier next to `target` (B, 2), in the state at tau = 0 and d
   distances along `rate` (B, k, d); `across` (B, d - 1, NX + d) closes them. Out: `periodic` (B, NX, w), the map over one period less
   the state; rho and its row `growth` (B, w); and for each of the `columns` the solution `step` (NX + d) and the changes dx, dX of the orbit, column after column: the first is Newton's, the second moves along the null
   direction of all rows but the last. Without a target there is but `periodic`, without distances no step. `good` (B) is 0 where a
   matrix is singular. Returns 0 without memory. */
EXPORT int srf_boundary(int B, int N, int k, const int *which, int d, int columns, const double *tau, const double *h,
                        const double *p, const double *x, const double *X, const double *target, const double *rate,
                        const double *across, double *periodic, double *rho, double *growth, double *step, double *dx, double *dX,
                        unsigned char *good) {
    const int w = NX + 1 + k, m = NX + d;
    linearised c;
    c.lu = malloc(sizeof(double) * ((size_t)N * (S * S + S * w + w * w) + (size_t)(N + 1) * w * w + (size_t)m * m + 2 * m));
    c.pivot = malloc(sizeof(int) * ((size_t)N * S + m));
    if (!c.lu || !c.pivot) {
        free(c.lu);
        free(c.pivot);
        return 0;
    }
    c.local = c.lu + (size_t)N * S * S;
    c.maps = c.local + (size_t)N * S * w;
    c.prefix = c.maps + (size_t)N * w * w;
    double *matrix = c.prefix + (size_t)(N + 1) * w * w, *right = matrix + (size_t)m * m;
    for (int b = 0; b < B; b++) {
        const double *own = p + (size_t)b * NP, *y = x + (size_t)b * N * NX, *Y = X + (size_t)b * N * S;
        double *end = periodic + (size_t)b * NX * w, *row = growth + (size_t)b * w, M[NX * NX], r[2 * NX], l[2 * NX];
        good[b] = 1;
        memset(c.maps, 0, sizeof(double) * N * w * w);
        memset(c.prefix, 0, sizeof(double) * (N + 1) * w * w);
        for (int i = 0; i <= N; i++)
            for (int a = i ? NX : 0; a < w; a++) c.prefix[(size_t)i * w * w + a * w + a] = 1.0;
        for (int i = 0; i < N && good[b]; i++) {
            double *map = c.maps + (size_t)i * w * w;
            good[b] = interval(h[i], tau + i * MS, own, y + i * NX, Y + i * S, y + (i + 1 < N ? i + 1 : 0) * NX, k, which,
                               c.lu + (size_t)i * S * S, c.pivot + i * S, c.local + (size_t)i * S * w, map);
            chained(w, map, c.prefix + (size_t)i * w * w, c.prefix + (size_t)(i + 1) * w * w);
        }
        for (int a = 0; a < NX; a++)
            for (int j = 0; j < w; j++) {
                double value = c.prefix[(size_t)N * w * w + a * w + j];
                end[a * w + j] = value - (a == j);
                if (j < NX) M[a * NX + j] = value;
                good[b] &= isfinite(value) != 0;
            }
        if (!good[b] || !target) continue;
        good[b] = (unsigned char)eigenpair(M, target + 2 * b, rho + 2 * b, r, l);
        if (!good[b]) continue;
        growth_row(N, k, which, tau, own, Y, &c, rho + 2 * b, r, l, row);
        if (!d) continue;
        const double *ways = rate + (size_t)b * k * d;
        for (int a = 0; a <= NX; a++) {
            const double *from = a < NX ? end + a * w : row;
            for (int j = 0; j < NX; j++) matrix[a * m + j] = from[j];
            for (int e = 0; e < d; e++) {
                double sum = 0.0;
                for (int j = 0; j < k; j++) sum += from[NX + 1 + j] * ways[j * d + e];
                matrix[a * m + NX + e] = sum;
            }
        }
        for (int i = 0; i < (d - 1) * m; i++) matrix[(NX + 1) * m + i] = across[(size_t)b * (d - 1) * m + i];
        memset(right, 0, sizeof(double) * 2 * m);
        for (int a = 0; a < NX; a++) right[a * columns] = -end[a * w + NX];
        right[NX * columns] = -0.5 * log(rho[2 * b] * rho[2 * b] + rho[2 * b + 1] * rho[2 * b + 1]) - row[NX];
        if (columns > 1) right[(m - 1) * columns + 1] = 1.0;
        good[b] = (unsigned char)factor(m, 1.0, matrix, c.pivot + (size_t)N * S);
        if (!good[b]) continue;
        solve(m, matrix, c.pivot + (size_t)N * S, NULL, right, columns);
        for (int j = 0; j < columns; j++) {
            const size_t at = (size_t)j * B + b;
            double head[NX + 1 + k], full[NX + 1 + k], *to = dx + at * N * NX, *TO = dX + at * N * S;
            for (int a = 0; a < m; a++) step[at * m + a] = right[a * columns + j];
            for (int a = 0; a < NX; a++) head[a] = right[a * columns + j];
            head[NX] = j ? 0.0 : 1.0;
            for (int i = 0; i < k; i++) {
                head[NX + 1 + i] = 0.0;
                for (int e = 0; e < d; e++) head[NX + 1 + i] += ways[i * d + e] * right[(NX + e) * columns + j];
            }
            for (int i = 0; i < N; i++) {
                const double *P = c.prefix + (size_t)i * w * w, *L = c.local + (size_t)i * S * w;
                memcpy(full, head, sizeof full);
                for (int a = 0; a < NX; a++) {
                    full[a] = 0.0;
                    for (int e = 0; e < w; e++) full[a] += P[a * w + e] * head[e];
                    to[i * NX + a] = full[a];
                }
                for (int s = 0; s < S; s++) {
                    double sum = 0.0;
                    for (int e = 0; e < w; e++) sum += L[s * w + e] * full[e];
                    TO[i * S + s] = sum;
                }
            }
        }
    }
    free(c.lu);
    free(c.pivot);
    return 1;
}
